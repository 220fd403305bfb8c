// One problem: the point of its box that is nearest to 0, and the joints that can move in coordinates of their own.
const size_t problem = pid;
const double* const given_low = lower + problem * N;
const double* const given_high = upper + problem * N;
int first = 0;                                        // coordinates that are taken

for (int i = lane; i < N; i += 32) {
  low[i] = given_low[i], high[i] = given_high[i], bent[i] = 0.0;
  x[i] = clip(0.0, low[i], high[i]);
  fixed[i] = low[i] == high[i] ? 2 : 0;
  blocking[i] = at_bound[i] = 0;
  for (int j = 0; j < N; ++j) turned[j * D + i] = 0.0;
}
__syncwarp();
for (int i = 0; i < N; ++i) first += fixed[i] != 0;
for (int i = 0, taken = 0; i < N; ++i) {
  const int j = fixed[i] != 0 ? taken : first + i - taken;
  if (lane == 0) turned[j * D + i] = 1.0;
  taken += fixed[i] != 0;
}
__syncwarp();
