// XLA's calls of the weighted QP and of its certificate on a CPU: one problem of a batch after another, in double precision.
#include <vector>

#include "qp_certificate.hpp"
#include "xla.hpp"

using namespace osik;

namespace {
// The numbers of a problem but its matrix, one array after another; returns where they end.
const double* read(QPData<double>& d, const double* at, const QPSizes& s) {
  const int m = s.m, n = s.n, p = s.p, N = n + p;
  auto take = [&](int count) { return at += count, at - count; };
  d.target = take(m), d.weight = take(m), d.damping = take(n), d.center = take(n), d.rows = take(p * n);
  d.compliance = take(p), d.lower = take(N), d.upper = take(N);
  return at;
}

// Arguments and results as in solvers/qp/_core.py; the second argument has all numbers of a problem but the matrix, the
// fourth its tolerance and the largest residual that is certified.
void solve_weighted_qps(const xla::Call& call) {
  using Method = WeightedQP<Serial<double>>;
  const int batch = call.size(0, 0), m = call.size(0, 1), n = call.size(0, 2), N = call.size(2, 1), p = N - n;
  const QPSizes s{m, n, p, call.in<int>(4)[0]};
  std::vector<double> space(Method::bytes(s) / sizeof(double));
  Method method(s, reinterpret_cast<char*>(space.data()));
  QPCertificate<Serial<double>> certificate(s, reinterpret_cast<char*>(space.data()));
  const double *matrix = call.in<double>(0), *packed = call.in<double>(1), *tolerances = call.in<double>(3);
  const int* guess = call.in<int>(2);
  QPAnswer<double> a{call.out<double>(0), call.out<double>(1), call.out<int>(2), call.out<int>(3)};
  for (int k = 0; k < batch; ++k) {
    QPData<double> d{};
    const double* at = read(d, packed, s);
    d.matrix = matrix, d.guess = guess, d.tolerance = tolerances[2 * k];
    call.out<double>(4)[k] = certificate.solve(method, d, a, tolerances[2 * k + 1]).residual;
    matrix += size_t(m) * n, packed = at, guess += N;
    a.x += n, a.multipliers += p, a.active += N, a.report += 3;
  }
}

// Arguments: matrix, other numbers, x, multipliers of the rows, labels, [B, 2] tolerance and largest residual. Results:
// whether the certificate holds, and the residual.
void judge_weighted_qps(const xla::Call& call) {
  const int batch = call.size(0, 0), m = call.size(0, 1), n = call.size(0, 2), N = call.size(4, 1), p = N - n;
  const QPSizes s{m, n, p, 0};
  std::vector<double> space(WeightedQP<Serial<double>>::bytes(s) / sizeof(double));
  QPCertificate<Serial<double>> certificate(s, reinterpret_cast<char*>(space.data()));
  const double* packed = call.in<double>(1);
  for (size_t k = 0; k < size_t(batch); ++k) {
    const double* tolerances = call.in<double>(5) + 2 * k;
    QPData<double> d{};
    packed = read(d, packed, s), d.matrix = call.in<double>(0) + k * m * n, d.tolerance = tolerances[0];
    const Certificate found = certificate.judge(d, call.in<double>(2) + k * n, call.in<double>(3) + k * p,
                                                call.in<int>(4) + k * N, tolerances[1]);
    call.out<int>(0)[k] = found.holds && found.is_exact, call.out<double>(1)[k] = found.residual;
  }
}
}  // namespace

extern "C" {
void* osik_weighted_qp(xla::CallFrame* frame) { return xla::handle<solve_weighted_qps>(frame); }

// Bytes of shared memory that a warp needs for one problem, a multiple of 16, and numbers beside it.
int osik_weighted_qp_bytes(int m, int n, int p, int single) {
  const QPSizes s{m, n, p, 0};
  return single ? WeightedQP<WarpSizes<float>>::bytes(s) : WeightedQP<WarpSizes<double>>::bytes(s);
}
int osik_weighted_qp_outside(int n, int p, int single) {
  return single ? DualActiveSet<WarpSizes<float>>::doubles(n, p) : DualActiveSet<WarpSizes<double>>::doubles(n, p);
}
void* osik_weighted_qp_certificate(xla::CallFrame* frame) { return xla::handle<judge_weighted_qps>(frame); }
}
