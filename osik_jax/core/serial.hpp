// The team of a CPU: one thread, whose loops over columns use the compiler's vectors.
#pragma once
#include <cmath>
#include <type_traits>
#include <utility>

#include "team.hpp"

namespace osik {

#if defined(__AVX512F__)
constexpr int VECTOR_BYTES = 64;
#elif defined(__AVX__)
constexpr int VECTOR_BYTES = 32;
#else
constexpr int VECTOR_BYTES = 16;
#endif

template <class R> struct Vector {
  using Real = R;
  static constexpr int LANES = VECTOR_BYTES / int(sizeof(Real));
  typedef Real Loaded __attribute__((vector_size(VECTOR_BYTES), aligned(sizeof(Real)), may_alias));
  typedef Real Value __attribute__((vector_size(VECTOR_BYTES)));
  typedef std::conditional_t<sizeof(Real) == 8, long long, int> Bits;
  typedef Bits Mask __attribute__((vector_size(VECTOR_BYTES)));
  OSIK_FN static Value all(Real a) { return Value{} + a; }
  OSIK_FN static Value size(Value a) { return a < 0 ? -a : a; }
};

template <class Real, int B> struct Columns {
  int at;
  using V = Vector<Real>;
  using P = Pack<V, B>;
  OSIK_FN P load(const Real* row) const {
    P p;
    for (int b = 0; b < B; ++b) p.v[b] = *(const typename V::Loaded*)(row + at + b * V::LANES);
    return p;
  }
  OSIK_FN void store(Real* row, const P& p) const {
    for (int b = 0; b < B; ++b) *(typename V::Loaded*)(row + at + b * V::LANES) = p.v[b];
  }
};

// An array of a workspace, at the place that At::of says [bytes].
template <class T, class At, class Sizes> struct PointerArray {
  T* data;
  OSIK_FN PointerArray(char* space, const Sizes& s) : data(reinterpret_cast<T*>(space + At::of(s))) {}
  OSIK_FN operator T*() const { return data; }
};

// A number that depends on a problem's sizes, as At::of says.
template <class At, class Sizes> struct SizeValue {
  int value;
  OSIK_FN SizeValue(char*, const Sizes& s) : value(At::of(s)) {}
  OSIK_FN operator int() const { return value; }
};

template <class R> struct Serial : CommonTeam<R> {
  using Real = R;
  template <class At, class Sizes> using Fixed = SizeValue<At, Sizes>;
  template <class T, class At, class Sizes> using Array = PointerArray<T, At, Sizes>;
  using Int = int;
  using Loaded = typename Vector<R>::Loaded;
  using Value = typename Vector<R>::Value;
  using Mask = typename Vector<R>::Mask;
  using Bits = typename Vector<R>::Bits;
  static constexpr int LANES = Vector<R>::LANES;
  static constexpr bool COPIES = true;  // a method copies the rows that it is given, so that they are padded
  static constexpr bool SPARES_SPACE = false, HOLDS_COLUMNS = false;
  static constexpr int BLOCK = 2 * 64 / int(sizeof(R));  // columns of a large pack
  static constexpr int WIDE = 64 / int(sizeof(R));  // the widest vector of any instruction set
  // a pack that begins at the last column ends within the row
  static constexpr int stride(int n) { return (n + 2 * WIDE - 2) / WIDE * WIDE; }
  // the end of the pack that holds the n-th number
  static constexpr int padded(int n) { return (n + LANES - 1) / LANES * LANES; }

  template <class F> OSIK_FN void each(int a, int b, F f) const {
    for (int i = a; i < b; ++i) f(i);
  }
  template <class F> OSIK_FN void once(F f) const { f(); }
  template <class F> OSIK_FN void pairs(int count, F f) const {
    for (int a = 0; a < count; ++a)
      for (int b = a; b < count; ++b) f(a, b);
  }
  OSIK_FN static Real inverse_root(Real a) { return Real(1) / std::sqrt(a); }
  template <class... P> OSIK_FN static void are_shared(P...) {}
  // the columns [from, to) of each row outside of which all entries are 0
  OSIK_FN void nonzero(const Real* A, int row, int, int rows, int n, Int* from, Int* to) const {
    for (int a = 0; a < rows; ++a, A += row) {
      int first = 0, last = n;
      while (first < n && A[first] == Real(0)) ++first;
      while (last > first && A[last - 1] == Real(0)) --last;
      from[a] = first, to[a] = last;
    }
  }
  template <class F> OSIK_FN void columns(int a, int b, F f) const {
    int j = a;
    for (; b - j > BLOCK - LANES; j += BLOCK) f(Columns<R, BLOCK / LANES>{j});
    narrow_columns(j, b, f);
  }
  template <class F> OSIK_FN void narrow_columns(int a, int b, F f) const {
    int j = a;
    if constexpr (LANES < WIDE)
      for (; b - j > WIDE - LANES; j += WIDE) f(Columns<R, WIDE / LANES>{j});
    for (; j < b; j += LANES) f(Columns<R, 1>{j});
  }

  // ---- reductions
  template <class F> OSIK_FN Real sum(int a, int b, F f) const {
    Real t = 0;
    for (int i = a; i < b; ++i) t += f(i);
    return t;
  }
  template <class F> OSIK_FN int count(int a, int b, F f) const {
    int t = 0;
    for (int i = a; i < b; ++i) t += f(i);
    return t;
  }
  OSIK_FN static bool all(bool flag) { return flag; }
  // the largest of `t` and the values f(i, largest so far); NaN stays
  template <class F> OSIK_FN Real most(Real t, int a, int b, F f) const {
    for (int i = a; i < b; ++i) {
      const Real v = f(i, t);
      t = v > t || v != v ? v : t;
    }
    return t;
  }
  // the largest value of f(i) above `t`, and the first index that has it
  template <class F> OSIK_FN Best<R> best(Real t, int a, int b, F f) const {
    Best<R> r{t, -1};
    for (int i = a; i < b; ++i) {
      const Real v = f(i);
      if (v > r.value) r = {v, i};
    }
    return r;
  }

  // the largest |a_j b_j| of rows of n numbers; NaN counts as none
  OSIK_FN static Real largest(const Real* a, const Real* b, int n) {
    Value most{};
    for (int j = 0; j < n; j += LANES) {
      const Value v = *(const Loaded*)(a + j) * *(const Loaded*)(b + j), size = v < 0 ? -v : v;
      most = size > most ? size : most;
    }
    Real found = 0;
    for (int e = 0; e < LANES; ++e) found = most[e] > found ? most[e] : found;
    return found;
  }

  // ---- vectors
  template <int K, class V> OSIK_FN static Real total_of(V x) {
    if constexpr (K == 1) return x[0];
    else if constexpr (K == 2) return x[0] + x[1];
    else {
      typedef Real Half __attribute__((vector_size(K / 2 * sizeof(Real))));
      Half low, high;
      __builtin_memcpy(&low, &x, sizeof low);
      __builtin_memcpy(&high, (const char*)&x + sizeof low, sizeof high);
      return total_of<K / 2>(low + high);
    }
  }
  OSIK_FN static Real total(Value x) { return total_of<LANES>(x); }
  // the totals of LANES vectors, as one vector
  template <int K> OSIK_FN static Value totals_of(const Value* x) {
    if constexpr (K == 1) return x[0];
    else return sum_of_groups<K>(totals_of<K / 2>(x), totals_of<K / 2>(x + K / 2), std::make_integer_sequence<int, LANES>());
  }
  // lane e of the result has the sum over one of K groups of lanes, of vector e % K; a has the sums over K / 2 groups of the
  // first K / 2 vectors, b those of the last
  template <int K, int... e> OSIK_FN static Value sum_of_groups(Value a, Value b, std::integer_sequence<int, e...>) {
    constexpr auto low = [](int lane) { return lane % K < K / 2 ? lane : LANES + lane - K / 2; };
    return shuffled<low(e)...>(a, b) + shuffled<low(e) + K / 2 ...>(a, b);
  }
  // lanes of two vectors, those of b numbered after those of a
  template <int... lane> OSIK_FN static Value shuffled(Value a, Value b) {
#if defined(__clang__)
    return __builtin_shufflevector(a, b, lane...);
#else  // before version 12, GCC has no __builtin_shufflevector
    return __builtin_shuffle(a, b, Mask{lane...});
#endif
  }
  // the first `count` numbers of a vector in memory, then zeros; the places of these zeros are read too
  OSIK_FN static Value first_of(const Real* a, int count) {
    Mask m{};
    for (int k = 0; k < LANES; ++k) m[k] = k < count ? -1 : 0;
    return (Value)((Mask) * (const Loaded*)a & m);
  }
  OSIK_FN static Real own_dot(const Real* a, const Real* b, int start, int stop, int = 1) {
    Value t{};
    int j = start;
    for (; j + LANES <= stop; j += LANES) t += *(const Loaded*)(a + j) * *(const Loaded*)(b + j);
    if (j < stop) t += first_of(a + j, stop - j) * first_of(b + j, stop - j);
    return total(t);
  }
  OSIK_FN static Real own_dot_on(const Real* a, const Real* b, int start, int n, int = 1) {
    Value t{}, u{};
    int j = start;
    for (; j + LANES < n; j += 2 * LANES) {
      t += *(const Loaded*)(a + j) * *(const Loaded*)(b + j);
      u += *(const Loaded*)(a + j + LANES) * *(const Loaded*)(b + j + LANES);
    }
    if (j < n) t += *(const Loaded*)(a + j) * *(const Loaded*)(b + j);
    return total(t + u);
  }
  // the sum of |a_j b_j|
  OSIK_FN static Real own_size_on(const Real* a, const Real* b, int n) {
    Value t{};
    for (int j = 0; j < n; j += LANES) {
      const Value v = *(const Loaded*)(a + j) * *(const Loaded*)(b + j);
      t += v < 0 ? -v : v;
    }
    return total(t);
  }
  // a += by b for rows of n numbers, from the pack of column `start` on
  OSIK_FN static void own_axpy_on(Real* a, Real by, const Real* b, int start, int n) {
    for (int j = start / LANES * LANES; j < n; j += LANES) *(Loaded*)(a + j) += by * *(const Loaded*)(b + j);
  }
  // the product of a row that is 0 outside of the columns [from, to) with a vector
  OSIK_FN static Real own_row(const Real* a, const Real* b, int, int, int n, int) { return own_dot_on(a, b, 0, n); }
  OSIK_FN static Real own_square(const Real* a, int start, int stop, int = 1) { return own_dot(a, a, start, stop); }
  OSIK_FN static void own_axpy(Real* a, Real by, const Real* b, int start, int stop) {
    int j = start;
    for (; j + LANES <= stop; j += LANES) *(Loaded*)(a + j) += by * *(const Loaded*)(b + j);
    if (j < stop) *(Loaded*)(a + j) += by * first_of(b + j, stop - j);
  }
  // the column after the last one that is not 0 in a row of n numbers, or one a little further
  OSIK_FN static int own_end(const Real* a, int n) {
    int end = padded(n);
    while (end > 0) {
      const Mask other = *(const Loaded*)(a + end - LANES) != 0;
      Bits any = 0;
      for (int e = 0; e < LANES; ++e) any |= other[e];
      if (any) break;
      end -= LANES;
    }
    return end;
  }
  // to [padded] = from [n], times a number; zeros after the n-th stay
  OSIK_FN void scaled_copy(Real* to, Real by, const Real* from, int n) const {
    int j = 0;
    for (; j + LANES <= n; j += LANES) *(Loaded*)(to + j) = by * *(const Loaded*)(from + j);
    if (j < n && n >= LANES) j = n - LANES, *(Loaded*)(to + j) = by * *(const Loaded*)(from + j);
    else
      for (; j < n; ++j) to[j] = by * from[j];
  }
  OSIK_FN void fetch(Real* to, const Real* from, int count) const { scaled_copy(to, 1, from, count); }
  OSIK_FN void fetch_rows(Real*, int, const Real*, int) const {}
  OSIK_FN void arrive() const {}
  // row a of `to` [rows, ld] = factor[a] times row a of `from` [rows, n]; no factor: 1
  OSIK_FN void scaled_rows(Real* to, int ld, const Real* factor, const Real* from, int rows, int n) const {
    for (int a = 0; a < rows; ++a) scaled_copy(to + a * ld, factor ? factor[a] : Real(1), from + a * n, n);
  }
  // products of A rows with LANES other rows, over the columns [start, n)
  template <int A> OSIK_FN static void products(const Real* const* a, const Real* const* b, int start, int n, Value* out) {
    Value t[A][LANES] = {};
    for (int j = start; j < n; j += LANES) {
      OSIK_UNROLL
      for (int e = 0; e < LANES; ++e) {
        const Value other = *(const Loaded*)(b[e] + j);
        OSIK_UNROLL
        for (int i = 0; i < A; ++i) t[i][e] += *(const Loaded*)(a[i] + j) * other;
      }
    }
    for (int i = 0; i < A; ++i) out[i] = totals_of<LANES>(t[i]);
  }
  // LANES rows from `first` on, the last one again where there are fewer; returns where the longest of them ends
  template <class Row, class End> OSIK_FN static int rows_from(Row row, End end, int first, int count, const Real** rows) {
    int longest = 0;
    for (int e = 0; e < LANES; ++e) {
      const int a = first + e < count ? first + e : count - 1, own = end(a);
      rows[e] = row(a), longest = own > longest ? own : longest;
    }
    return longest;
  }
  // out[a] = row(a) . v for all a < count; row(a) is 0 from column end(a) on, and out has padded(count) places
  template <class Row, class End> OSIK_FN void rows_times(Row row, End end, const Real* v, Real* out, int count) const {
    for (int first = 0; first < count; first += LANES) {
      const Real* rows[LANES];
      const int longest = rows_from(row, end, first, count, rows);
      Value total;
      products<1>(&v, rows, 0, longest, &total);
      *(Loaded*)(out + first) = total;
    }
  }
  // S[a, b] = sum_j row(a)_j weight_j row(b)_j for a <= b < count, and any numbers up to padded(count); work: [2, ld]
  template <class Row, class End>
  OSIK_FN void weighted_gram(Row row, End end, const Real* weight, Real* S, Real* work, int ld_S, int ld, int count) const {
    for (int a = 0; a < count; a += 2) {
      const int next = a + 1 < count ? a + 1 : a, stop = end(a) > end(next) ? end(a) : end(next);
      const Real *scaled[2] = {work, work + ld}, *own[2] = {row(a), row(next)};
      for (int i = 0; i < 2; ++i)
        for (int j = 0; j < stop; j += LANES)
          *(Loaded*)(work + i * ld + j) = *(const Loaded*)(own[i] + j) * *(const Loaded*)(weight + j);
      for (int first = a / LANES * LANES; first < count; first += LANES) {
        const Real* rows[LANES];
        const int longest = rows_from(row, end, first, count, rows);
        Value total[2];
        products<2>(scaled, rows, 0, longest < stop ? longest : stop, total);
        *(Loaded*)(S + a * ld_S + first) = total[0];
        *(Loaded*)(S + next * ld_S + first) = total[next - a];
      }
    }
  }
  OSIK_FN Real dot(const Real* a, const Real* b, int start, int stop) const { return own_dot(a, b, start, stop); }
  OSIK_FN void axpy(Real* a, Real by, const Real* b, int start, int stop) const { own_axpy(a, by, b, start, stop); }

  // ---- reflections: some rows M become M (I - scale v v'), from column `at` on
  template <int K> static void reflect_packs(Real* M, int ld, int count, const Real* v, Real scale) {
    Value w[K], x[K];
    OSIK_UNROLL
    for (int k = 0; k < K; ++k) w[k] = *(const Loaded*)(v + k * LANES);
    for (int q = 0; q < count; ++q, M += ld) {
      Value t{};
      OSIK_UNROLL
      for (int k = 0; k < K; ++k) x[k] = *(const Loaded*)(M + k * LANES), t += x[k] * w[k];
      const Real by = -scale * total(t);
      OSIK_UNROLL
      for (int k = 0; k < K; ++k) *(Loaded*)(M + k * LANES) = x[k] + by * w[k];
    }
  }
  void reflect(Real* rows, int ld, int count, const Real* v, Real scale, int at, int n) const {
    Real* M = rows + at;
    v += at;
    switch ((n - at + LANES - 1) / LANES) {  // with all of v in registers
      case 1: return reflect_packs<1>(M, ld, count, v, scale);
      case 2: return reflect_packs<2>(M, ld, count, v, scale);
      case 3: return reflect_packs<3>(M, ld, count, v, scale);
      case 4: return reflect_packs<4>(M, ld, count, v, scale);
      case 5: return reflect_packs<5>(M, ld, count, v, scale);
      case 6: return reflect_packs<6>(M, ld, count, v, scale);
      default:
        for (int q = 0; q < count; ++q, M += ld) {
          const Real by = -scale * own_dot_on(M, v, 0, n - at);
          for (int j = 0; j < n - at; j += LANES) *(Loaded*)(M + j) += by * *(const Loaded*)(v + j);
        }
    }
  }

  // ---- triangular systems: y <- L^-1 y and y <- L'^-1 y; `inverse` holds the inverses of the diagonal of L
  OSIK_FN void forward(const Real* L, int ld, const Real* inverse, Real* y, int count) const {
    for (int k = 0; k < count; ++k) y[k] = (y[k] - own_dot(L + k * ld, y, 0, k)) * inverse[k];
  }
  OSIK_FN void backward(const Real* L, int ld, const Real* inverse, Real* y, int count) const {
    for (int k = count - 1; k >= 0; --k) {
      y[k] *= inverse[k];
      own_axpy(y, -y[k], L + k * ld, 0, k);
    }
  }
};

}  // namespace osik
