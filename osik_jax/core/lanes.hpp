// Numbers of several robots at once, for text that does the same for each of them: vectors of the compiler.
//
// Where such text decides by numbers, it says select(which, a, b), and any(which) where all may leave something out. One
// robot has these words too (rigid.hpp).
#pragma once
#include <cmath>

#include "rigid.hpp"

namespace osik {

// One number of each robot of a pack.
template <class R> struct Lanes {
  static constexpr int BYTES = 32, COUNT = BYTES / int(sizeof(R));
  typedef R Value __attribute__((vector_size(BYTES)));
  typedef std::conditional_t<sizeof(R) == 8, long long, int> Bits;
  typedef Bits Flags __attribute__((vector_size(BYTES)));
  // A condition on each robot.
  struct Which {
    Flags v;
    friend OSIK_FN Which operator&(Which a, Which b) { return {a.v & b.v}; }
    friend OSIK_FN Which operator|(Which a, Which b) { return {a.v | b.v}; }
    friend OSIK_FN Which operator!(Which a) { return {~a.v}; }
    friend OSIK_FN bool any(Which a) {
      Bits found = 0;
      for (int k = 0; k < COUNT; ++k) found |= a.v[k];
      return found != 0;
    }
  };
  Value v;

  Lanes() = default;
  OSIK_FN Lanes(double a) : v(Value{} + R(a)) {}
  OSIK_FN static Lanes of(Value v) {
    Lanes to;
    return to.v = v, to;
  }
  // f of the number of each robot
  template <class F> OSIK_FN static Lanes each(F f) {
    Lanes to;
    for (int k = 0; k < COUNT; ++k) to.v[k] = f(k);
    return to;
  }
  OSIK_FN Lanes& operator+=(Lanes b) { return v += b.v, *this; }
  OSIK_FN Lanes& operator-=(Lanes b) { return v -= b.v, *this; }
  friend OSIK_FN Lanes operator-(Lanes a) { return of(-a.v); }
  friend OSIK_FN Lanes operator+(Lanes a, Lanes b) { return of(a.v + b.v); }
  friend OSIK_FN Lanes operator-(Lanes a, Lanes b) { return of(a.v - b.v); }
  friend OSIK_FN Lanes operator*(Lanes a, Lanes b) { return of(a.v * b.v); }
  friend OSIK_FN Lanes operator/(Lanes a, Lanes b) { return of(a.v / b.v); }
  friend OSIK_FN Which operator<(Lanes a, Lanes b) { return {a.v < b.v}; }
  friend OSIK_FN Which operator<=(Lanes a, Lanes b) { return {a.v <= b.v}; }
  friend OSIK_FN Which operator>(Lanes a, Lanes b) { return {a.v > b.v}; }
  friend OSIK_FN Which operator==(Lanes a, Lanes b) { return {a.v == b.v}; }
  friend OSIK_FN Which operator!=(Lanes a, Lanes b) { return {a.v != b.v}; }
  friend OSIK_FN Lanes select(Which which, Lanes a, Lanes b) { return of(which.v ? a.v : b.v); }
  friend OSIK_FN Lanes fabs(Lanes a) { return of(a.v < 0 ? -a.v : a.v); }
  friend OSIK_FN Lanes sqrt(Lanes a) {
    return each([&](int k) { return std::sqrt(a.v[k]); });
  }
};

template <class R> OSIK_FN Vec3<R> lane_of(const Vec3<Lanes<R>>& v, int k) { return {v.x.v[k], v.y.v[k], v.z.v[k]}; }
template <class R> OSIK_FN Mat3<R> lane_of(const Mat3<Lanes<R>>& m, int k) {
  return {lane_of(m.a, k), lane_of(m.b, k), lane_of(m.c, k)};
}
// Sine and cosine to 1e-16. The angle less the next multiple k pi/2, of which pi/2 has three parts; the polynomials have the
// coefficients of Sun's fdlibm (k_sin.c, k_cos.c). Large angles and those that are not finite: robot by robot.
template <class R> void sine_and_cosine(Lanes<R> angle, Lanes<R>& sine, Lanes<R>& cosine) {
  using L = Lanes<R>;
  if constexpr (sizeof(R) == 8) {
    if (!any(!(fabs(angle) <= L(1e5)))) {
      const L whole = 6755399441055744.0, shifted = angle * L(0.63661977236758134) + whole, k = shifted - whole;
      const L r = ((angle - k * L(1.57079632673412561417e+00)) - k * L(6.07710050630396597660e-11)) -
                  k * L(2.02226624879595063154e-21);
      const L z = r * r, s = r + r * z *
                                     (-1.66666666666666324348e-01 +
                                      z * (8.33333333332248946124e-03 +
                                           z * (-1.98412698298579493134e-04 +
                                                z * (2.75573137070700676789e-06 +
                                                     z * (-2.50507602534068634195e-08 + z * 1.58969099521155010221e-10)))));
      const L c = 1 - 0.5 * z +
                  z * z *
                      (4.16666666666666019037e-02 +
                       z * (-1.38888888888741095749e-03 +
                            z * (2.48015872894767294178e-05 +
                                 z * (-2.75573143513906633035e-07 +
                                      z * (2.08757232129817482790e-09 - z * 1.13596475577881948265e-11)))));
      const typename L::Flags turn = __builtin_bit_cast(typename L::Flags, shifted.v);
      const typename L::Which odd{(turn & 1) != 0}, down{(turn & 2) != 0}, left{((turn + 1) & 2) != 0};
      const L high = select(odd, c, s), across = select(odd, s, c);
      sine = select(down, -high, high), cosine = select(left, -across, across);
      return;
    }
  }
  sine = L::each([&](int k) { return std::sin(angle.v[k]); }), cosine = L::each([&](int k) { return std::cos(angle.v[k]); });
}

// An entry of arrays, or as many neighbours as a pack has.
template <class Real> struct Entries {
  static constexpr bool ALONE = sizeof(Real) == sizeof(double);
  size_t first;
  OSIK_FN Real operator()(const double* from) const {
    Real some;
    __builtin_memcpy(&some, from + first, sizeof some);
    return some;
  }
  // of a leaf, a scalar of which is each entry (moving_rows.hpp)
  template <class Leaf> OSIK_FN Real of(const Leaf& leaf) const { return leaf.size > 1 ? (*this)(leaf.at) : Real(*leaf.at); }
  OSIK_FN void put(Real a, double* to) const { __builtin_memcpy(to + first, &a, sizeof a); }
  OSIK_FN auto are(const int* labels, int label) const {  // whether they are this label
    if constexpr (ALONE) return labels[first] == label;
    else {
      typename Real::Which to;
      for (int k = 0; k < Real::COUNT; ++k) to.v[k] = labels[first + k] == label ? -1 : 0;
      return to;
    }
  }
};
// f of all entries before `count`
template <class F> OSIK_FN void each_entry(size_t count, F f) {
  constexpr size_t SOME = Lanes<double>::COUNT;
  size_t i = 0;
  for (; i + SOME <= count; i += SOME) f(Entries<Lanes<double>>{i});
  for (; i < count; ++i) f(Entries<double>{i});
}
// The largest of numbers from 0 on, and their sum.
struct Gathered {
  Lanes<double> some = 0;
  double one = 0;
  OSIK_FN void most(double a) { one = select(a > one, a, one); }
  OSIK_FN void most(Lanes<double> a) { some = select(a > some, a, some); }
  OSIK_FN void add(double a) { one += a; }
  OSIK_FN void add(Lanes<double> a) { some += a; }
  OSIK_FN double largest() const {
    double found = one;
    for (int k = 0; k < Lanes<double>::COUNT; ++k) found = some.v[k] > found ? some.v[k] : found;
    return found;
  }
  OSIK_FN double sum() const { return one + (some.v[0] + some.v[1]) + (some.v[2] + some.v[3]); }
};
// The words of a team for these (warp.hpp has them for a GPU)
template <class Team> using GatheredBy = Gathered;
template <class Team> using EntryOf = Entries<double>;
template <class R, class F> OSIK_FN void each_entry(const Serial<R>&, size_t count, F f) { each_entry(count, f); }
OSIK_FN RowSums<double> row_sums(const Serial<double>&, const double* row, const double* x, int n) {
  Gathered value, size;
  each_entry(n, [&](auto e) {
    const auto term = e(row) * e(x);
    value.add(term), size.add(fabs(term));
  });
  return {value.sum(), size.sum()};
}
template <class F> OSIK_FN bool any_of(const double* at, size_t count, F f) {
  bool found = false;
  typename Lanes<double>::Which some{};
  each_entry(count, [&](auto e) {
    if constexpr (decltype(e)::ALONE) found |= f(e(at));
    else some = some | f(e(at));
  });
  return found || any(some);
}
OSIK_FN bool has_nan(const double* at, size_t count) {
  return any_of(at, count, [](auto a) { return a != a; });
}
OSIK_FN bool all_finite(const double* at, size_t count) {
  return !any_of(at, count, [](auto a) { return a - a != a - a; });
}

// These decide at several places, once for each task: robot by robot.
template <class R> Vec3<Lanes<R>> rotation_log(const Mat3<Lanes<R>>& m) {
  Vec3<Lanes<R>> to;
  for (int k = 0; k < Lanes<R>::COUNT; ++k) {
    const Vec3<R> one = rotation_log(lane_of(m, k));
    to.x.v[k] = one.x, to.y.v[k] = one.y, to.z.v[k] = one.z;
  }
  return to;
}
template <class R> Lanes<R> turn_factor(Lanes<R> s) {
  return Lanes<R>::each([&](int k) { return turn_factor(R(s.v[k])); });
}

// The numbers of a pack in an array, each robot `apart` from the one before; 0 where they share them.
template <class R> struct LaneNumbers {
  using Number = Lanes<R>;
  const R* at = nullptr;
  size_t apart = 0;
  OSIK_FN Lanes<R> operator[](int i) const {
    return apart ? Lanes<R>::each([&](int k) { return at[i + k * apart]; }) : Lanes<R>(at[i]);
  }
  OSIK_FN LaneNumbers operator+(int i) const { return {at + i, apart}; }
  OSIK_FN LaneNumbers& operator+=(int i) { return at += i, *this; }
  explicit operator bool() const { return at; }
};

// The same for results.
template <class R> struct LaneResults {
  using Number = Lanes<R>;
  struct Place {
    R* at;
    size_t apart;
    OSIK_FN operator Lanes<R>() const {
      return Lanes<R>::each([&](int k) { return at[k * apart]; });
    }
    OSIK_FN void operator=(Lanes<R> a) const {
      for (int k = 0; k < Lanes<R>::COUNT; ++k) at[k * apart] = a.v[k];
    }
    OSIK_FN void operator+=(Lanes<R> a) const { *this = Lanes<R>(*this) + a; }
  };
  R* at = nullptr;
  size_t apart = 0;
  OSIK_FN Place operator[](int i) const { return {at + i, apart}; }
  OSIK_FN LaneResults operator+(int i) const { return {at + i, apart}; }
  OSIK_FN LaneResults& operator+=(int i) { return at += i, *this; }
  explicit operator bool() const { return at; }
};
}  // namespace osik
