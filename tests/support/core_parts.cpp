// The parts of the core beside plain sums: linear algebra of the CPU's team, its layouts, rotations, distances in single
// precision, and the reader of a controller's file. Prints how many comparisons it made; the first that fails ends the program with its line.
#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <random>
#include <stdexcept>
#include <string>
#include <vector>

#include "c/section.hpp"
#include "convex_distance.hpp"
#include "linear_algebra.hpp"
#include "rigid.hpp"

using namespace osik;

static long compared = 0;
static std::mt19937 generator(7);

static void check(bool holds, int line, double found = 0, double wanted = 0) {
  ++compared;
  if (holds) return;
  std::fprintf(stderr, "line %d: found %.17g, wanted %.17g\n", line, found, wanted);
  std::exit(1);
}
#define CHECK(...) check((__VA_ARGS__), __LINE__)
#define NEAR(found, wanted, tolerance) check(std::fabs((found) - (wanted)) <= (tolerance), __LINE__, (found), (wanted))

static double any() { return std::normal_distribution<double>()(generator); }

// Rows of n numbers with the stride of the team and zeros in the padding; each matrix has memory of its own, so that a
// sanitizer sees what is read or written outside of it.
template <class Real> struct Rows {
  int rows, n, ld;
  std::vector<Real> data;
  Rows(int rows, int n, bool filled = true) : rows(rows), n(n), ld(Serial<Real>::stride(n)), data(size_t(rows) * ld) {
    for (int i = 0; filled && i < rows; ++i)
      for (int j = 0; j < n; ++j) data[i * ld + j] = Real(any());
  }
  Real* begin() { return data.data(); }
  Real* row(int i) { return data.data() + i * ld; }
  Real& at(int i, int j) { return data[i * ld + j]; }
  double get(int i, int j) const { return double(data[i * ld + j]); }
};

// sum_k f(k), as double
template <class F> static double sum(int from, int to, F f) {
  double total = 0;
  for (int k = from; k < to; ++k) total += f(k);
  return total;
}

template <class Real> struct Parts {
  using Team = Serial<Real>;
  using Algebra = LinearAlgebra<Team>;
  using Matrix = Rows<Real>;
  const Team t{};
  const double eps = sizeof(Real) == 8 ? 2.3e-16 : 1.2e-7;

  void strides() {
    for (int n = 0; n < 200; ++n) {
      CHECK(Team::padded(n) >= n && Team::padded(n) % Team::LANES == 0);
      CHECK(Team::stride(n) >= Team::padded(n));
      if (n) CHECK(Team::stride(n) >= n - 1 + Team::WIDE);  // a pack from the last column on
    }
  }

  void products(int rows, int n) {
    Matrix A(rows, n), M(n, n), v(1, n), out(1, n > rows ? n : rows, false), R(rows, n, false), S(rows, rows, false);
    const double tolerance = 30 * eps * (n + 1);
    Algebra::times(t, A.begin(), v.begin(), out.begin(), A.ld, 0, n, rows);
    for (int i = 0; i < rows; ++i)
      NEAR(out.at(0, i), sum(0, n, [&](int j) { return A.get(i, j) * v.get(0, j); }), tolerance);
    Algebra::transposed_times(t, M.begin(), v.begin(), out.begin(), M.ld, 0, n);
    for (int j = 0; j < n; ++j) NEAR(out.at(0, j), sum(0, n, [&](int i) { return M.get(i, j) * v.get(0, i); }), tolerance);
    Algebra::product(t, A.begin(), A.ld, 1, M.begin(), M.ld, R.begin(), R.ld, rows, n, n);
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < n; ++j) NEAR(R.at(i, j), sum(0, n, [&](int k) { return A.get(i, k) * M.get(k, j); }), tolerance);
    Algebra::combine(t, M.begin(), v.begin(), out.begin(), M.ld, n, 0, n, false);
    for (int j = 0; j < n; ++j) NEAR(out.at(0, j), sum(0, n, [&](int k) { return v.get(0, k) * M.get(k, j); }), tolerance);
    Matrix turned(n, rows, false), diagonal(1, rows, false);
    Algebra::transpose(t, A.begin(), A.ld, 1, turned.begin(), turned.ld, rows, n);
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < n; ++j) CHECK(turned.at(j, i) == A.at(i, j));
    for (const bool lower : {false, true}) {
      Algebra::gram(t, A.begin(), S.begin(), diagonal.begin(), A.ld, S.ld, rows, 0, n, lower);
      for (int a = 0; a < rows; ++a)
        for (int b = a; b < rows; ++b) {
          const double found = a == b ? diagonal.at(0, a) : lower ? S.at(b, a) : S.at(a, b);
          NEAR(found, sum(0, n, [&](int j) { return A.get(a, j) * A.get(b, j); }), tolerance);
        }
    }
  }

  // L L' is the matrix with the ridge, and S^-1 b solves S x = b
  void factors(int n) {
    Matrix A(n, n + 2), S(n, n, false), diagonal(1, n, false), inverse(1, n, false), M(n, n, false), b(1, n),
        work(1, n, false);
    const double ridge = 0.5, tolerance = 200 * eps * (n + 1) * (n + 1);
    const auto gram = [&](int i, int j) { return sum(0, n + 2, [&](int k) { return A.get(i, k) * A.get(j, k); }); };
    Algebra::gram(t, A.begin(), S.begin(), diagonal.begin(), A.ld, S.ld, n, 0, n + 2, false);
    Algebra::cholesky(t, S.begin(), diagonal.begin(), inverse.begin(), S.ld, n, Real(ridge), false);
    const auto entry = [&](int i, int k) { return i == k ? 1 / double(inverse.at(0, k)) : S.get(i, k); };
    for (int i = 0; i < n; ++i)
      for (int j = 0; j <= i; ++j)
        NEAR(sum(0, j + 1, [&](int k) { return entry(i, k) * entry(j, k); }), gram(i, j) + (i == j ? ridge : 0), tolerance);

    for (int i = 0; i < n; ++i)
      for (int j = i; j < n; ++j) S.at(i, j) = Real(gram(i, j) + (i == j ? ridge : 0));
    Matrix x = b;
    CHECK(Algebra::inverse_factor(t, S.begin(), M.begin(), inverse.begin(), diagonal.begin(), S.ld, n, Real(1e-6)));
    Algebra::apply_inverse(t, M.begin(), inverse.begin(), x.begin(), work.begin(), M.ld, n);
    for (int i = 0; i < n; ++i)
      NEAR(sum(0, n, [&](int j) { return (gram(i, j) + (i == j ? ridge : 0)) * x.get(0, j); }), b.get(0, i), 20 * tolerance);
    if (n < 2) return;
    for (int i = 0; i < n; ++i)
      for (int j = i; j < n; ++j) S.at(i, j) = 1;  // of rank 1
    CHECK(!Algebra::inverse_factor(t, S.begin(), M.begin(), inverse.begin(), diagonal.begin(), S.ld, n, Real(1e-6)));
  }

  // Q' R: below the diagonal of the pivots zeros, and products of columns as before; the rank of dependent columns
  void orthogonal(int rows, int n) {
    Matrix R(rows, n), V(rows, rows, false), squares(1, n, false), scales(1, rows, false);
    if (n > 2)
      for (int i = 0; i < rows; ++i) R.at(i, 2) = 2 * R.at(i, 0) - R.at(i, 1);
    const Matrix before = R;
    Matrix again = before;
    std::vector<int> pivot(rows);
    const int rank = Algebra::pivoted_qr(t, R.begin(), V.begin(), nullptr, squares.begin(), scales.begin(), pivot.data(),
                                         R.ld, V.ld, rows, 0, n, Real(100 * eps));
    const int independent = n > 2 ? n - 1 : n;
    CHECK(rank == (rows < independent ? rows : independent));
    const double tolerance = 300 * eps * (rows + 1);
    for (int k = 0; k < rank; ++k)
      for (int i = k + 1; i < rows; ++i) NEAR(R.at(i, pivot[k]), 0, tolerance);
    for (int a = 0; a < n; ++a)
      for (int b = 0; b < n; ++b)
        NEAR(sum(0, rows, [&](int i) { return R.get(i, a) * R.get(i, b); }),
             sum(0, rows, [&](int i) { return before.get(i, a) * before.get(i, b); }), 10 * tolerance);
    Algebra::apply_reflections(t, V.begin(), nullptr, scales.begin(), again.begin(), V.ld, 0, again.ld, rank, rows, n);
    for (int i = 0; i < rows; ++i)
      for (int j = 0; j < n; ++j) NEAR(again.at(i, j), R.get(i, j), 10 * tolerance);
  }

  // M (M'y - b) = 0
  void least_squares(int rows, int columns) {
    Matrix M(rows + 1, columns), v(1, columns, false), inverse(1, rows, false);
    const Matrix before = M;
    Algebra::least_squares_of_rows(t, M.begin(), v.begin(), inverse.begin(), M.ld, rows, columns);
    for (int a = 0; a < rows; ++a)
      NEAR(sum(0, columns,
               [&](int j) {
        return before.get(a, j) *
               (sum(0, rows, [&](int k) { return before.get(k, j) * M.get(rows, k); }) - before.get(rows, j));
      }),
           0, 1e4 * eps * columns);
  }

  void all() {
    strides();
    for (int n : {1, 2, 3, 4, 5, 7, 8, 9, 15, 16, 17, 24, 31, 33}) {
      for (int rows : {1, 2, 3, 6, 13}) products(rows, n), orthogonal(rows, n);
      factors(n);
      for (int rows = 1; 2 * rows <= n; rows += 2) least_squares(rows, n);
    }
  }
};

static void rotations() {
  for (int k = 0; k < 2000; ++k) {
    Quaternion<double> q{any(), any(), any(), any()};
    if (k % 5 == 0) q.w = 0;  // half turns
    if (k % 7 == 0) q.x = q.y = 0;
    const auto unit = q.normalized();
    const auto m = q.rotation();  // of any length
    const auto back = quaternion_of(m);
    const double same = std::fabs(unit.w * back.w + inner(unit.vector(), back.vector()));
    NEAR(same, 1, 1e-14);
    CHECK(back.w >= 0);
    const Vec3<double> v{any(), any(), any()};
    const auto turned = m * v, carried = unit.carry(v), restored = m.transposed() * turned;
    NEAR(inner(turned - carried, turned - carried), 0, 1e-28 * (1 + inner(v, v)));
    NEAR(inner(restored - v, restored - v), 0, 1e-28 * (1 + inner(v, v)));
    const Quaternion<double> p{any(), any(), any(), any()};
    const auto both = (p * q).rotation() * v, one_by_one = p.rotation() * (m * v);
    NEAR(inner(both - one_by_one, both - one_by_one), 0, 1e-27 * (1 + inner(v, v)));
  }
}

// Single precision beside double, for small shapes that touch large ones by up to 1 mm or hardly do not: a shape that
// touches is never called apart, and no distance is too large.
static void shallow_overlaps() {
  std::uniform_real_distribution<double> share(0.02, 1), depth(-3e-4, 1e-3);
  constexpr int KINDS[] = {BOX, CYLINDER, CAPSULE, SPHERE};
  int touching = 0;
  for (int k = 0; k < 8000; ++k) {
    float numbers[2][10];  // size, position, quaternion
    for (int shape = 0; shape < 2; ++shape)
      for (int i = 0; i < 10; ++i) numbers[shape][i] = float(i < 3 ? share(generator) * (shape ? 0.5 : 0.05) : any());
    if (k % 2) std::copy(numbers[0] + 6, numbers[0] + 10, numbers[1] + 6);  // faces that are parallel
    auto made = [&](int shape, auto zero) {
      using Real = decltype(zero);
      const float* from = numbers[shape];
      const auto turn = Quaternion<double>{from[6], from[7], from[8], from[9]}.rotation();
      float rows[9];
      turn.a.put(rows), turn.b.put(rows + 3), turn.c.put(rows + 6);
      Convex<Real> to{};
      to.kind = KINDS[shape ? k / 2 % 2 : k / 4 % 4];
      to.size = {Real(from[0]), Real(from[1]), Real(from[2])}, to.position = {Real(from[3]), Real(from[4]), Real(from[5])};
      Real turned[9];
      std::copy(rows, rows + 9, turned), to.rotation = Mat3<Real>::of(turned);
      return to;
    };
    auto truth = [&] { return gap_between(made(0, 0.0), made(1, 0.0)); };
    const double wanted = -depth(generator);
    for (int step = 0; step < 6; ++step) {
      const auto gap = truth();
      const auto move = (gap.distance - wanted) * gap.normal;
      numbers[0][3] += float(move.x), numbers[0][4] += float(move.y), numbers[0][5] += float(move.z);
    }
    const double distance = truth().distance;
    if (!(distance < 1e-5 && distance > -2e-3)) continue;
    ++touching;
    CHECK(!is_apart(made(0, 0.0f), made(1, 0.0f), float(SINGLE_TOUCH)));
    CHECK(gap_between(made(0, 0.0f), made(1, 0.0f)).distance - distance < SINGLE_TOUCH);
  }
  CHECK(touching > 5000);
}

static bool is_refused(const std::string& text) {
  try {
    JsonReader(text.c_str()).value();
  } catch (const std::runtime_error&) { return true; }
  return false;
}

static void sections() {
  const std::string text = R"({"a": [1, -2.5e3, true, Infinity, -Infinity], "b": {"c": "x\"y\\z\u0041\n"}, "d": []})";
  const Json all = JsonReader(text.c_str()).value();
  const auto a = all["a"].numbers<double>();
  CHECK(a.size() == 5 && a[0] == 1 && a[1] == -2500 && a[2] == 1 && a[3] == HUGE_VAL && a[4] == -HUGE_VAL);
  CHECK(all["b"]["c"].text == "x\"y\\zA\n" && all["d"].items.empty() && !all.find("e"));
  for (const char* wrong : {"[1.5]", "[1e99]", "[Infinity]"}) {  // no integers
    bool refused = false;
    try {
      JsonReader(wrong).value().numbers<int>();
    } catch (const std::runtime_error&) { refused = true; }
    CHECK(refused);
  }
  for (const char* wrong :
       {"", "[", "[1", "{\"a\"", "{\"a\":", "\"a", "\"\\", "\"\\u00", "\"\\u00g1\"", "[[[[[[1]]]]]]", "nan"})
    CHECK(is_refused(wrong));
  for (size_t cut = 0; cut < text.size(); ++cut) CHECK(is_refused(text.substr(0, cut)));
}

int main() {
  Parts<double>().all();
  Parts<float>().all();
  rotations();
  shallow_overlaps();
  sections();
  std::printf("%ld", compared);
}
