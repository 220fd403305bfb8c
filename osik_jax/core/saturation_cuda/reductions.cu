// What all lanes of the warp know of a number that each has one of.
auto warp_sum = [&](double a) {
  for (int distance = 16; distance; distance /= 2) a += __shfl_xor_sync(ALL, a, distance);
  return a;
};
auto warp_max = [&](double a) {
  for (int distance = 16; distance; distance /= 2) a = fmax(a, __shfl_xor_sync(ALL, a, distance));
  return a;
};
auto warp_argmax = [&](double& a, int& which) {       // in all lanes, with the least index among equals
  for (int distance = 16; distance; distance /= 2) {
    double other = __shfl_xor_sync(ALL, a, distance);
    int index = __shfl_xor_sync(ALL, which, distance);
    if (other > a || (other == a && index < which)) a = other, which = index;
  }
};
auto any = [&](bool a) { return __any_sync(ALL, a) != 0; };
auto is_finite = [](double a) { return fabs(a) <= 1.7e308; };
auto clip = [](double a, double low, double high) { return fmin(fmax(a, low), high); };
