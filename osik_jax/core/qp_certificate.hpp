// Checks whether a candidate solves its weighted QP: active constraints are at their bounds, the gradient is 0 elsewhere,
// multipliers have their signs, inactive constraints hold, and the residual (kkt_residual in solvers/qp/_problem.py) is
// small. No gradient has to be smaller than the roundoff of its terms. A CPU judges by the data alone; a GPU by the rows
// that the search has copied, with their weights multiplied in.
#pragma once
#include "lanes.hpp"
#include "weighted_qp.hpp"

namespace osik {

struct Certificate {
  bool holds;
  double residual;       // of the optimality conditions, without units
  bool is_exact = true;  // whether the gradient is roundoff where it has to be 0, which no search needs to reach
};

// What an answer is, the best one last: a candidate whose certificate fails, or that of a problem whose hard rows contradict
// each other or the box.
enum Outcome { NOTHING, CANDIDATE, SOLUTION, LEAST_VIOLATION };

template <class Team> class QPCertificate {
  using Real = typename Team::Real;
  using Int = typename Team::Int;
  using Method = WeightedQP<Team>;
  using Gathered = GatheredBy<Team>;
  using Space = typename Method::Space;
  static constexpr Real EPS = Method::EPS, REDUNDANT_TOL = DualActiveSet<Team>::REDUNDANT_BELOW;
  Team t;
  char* space;
  QPSizes size;
  OSIK_PLACED(Size, 0, m, n, p);
  OSIK_PLACED(Size, Team::SPARES_SPACE ? 5 : 1, ld);  // of rows that a GPU has copied, or as given
  Real scaled, plain, tolerance;  // sizes of x: per root of a curvature, and per unit
  // in the workspace of a search that is over: sizes of x, the gradient, the sizes of its terms of the cost and of the rows,
  // roots of the curvature of the cost [n]; pulls of the rows, and the sizes of their terms [m]
  OSIK_PLACED(Numbers, 8, SIZE, GRADIENT, SCALE, ROW_TERMS, ROOT, INVERSE_ROOT, ONES, FORCE, TERMS);

 public:
  OSIK_FN QPCertificate(const QPSizes& s, char* space) : space(space), size(s) {}

  // Solve a problem by the method whose workspace this is, and judge the answer. is_final: no search follows, so no gradient
  // has to be roundoff, and the least violation needs no proof that there is no point without one
  OSIK_CALL Certificate solve(Method& method, const QPData<Real>& d, const QPAnswer<Real>& to, Real kkt_tol,
                              bool is_final = false) {
    auto judged = [&](const Real* compliance) {
      if constexpr (Team::SPARES_SPACE) {
        auto own = method.copied();
        own.compliance = compliance;
        return judge(own, method.X, method.Z + m, method.LABEL, kkt_tol);
      } else {
        auto own = d;
        own.compliance = compliance;
        return judge(own, to.x, to.multipliers, to.active, kkt_tol);
      }
    };
    auto accepts = [&](const Certificate& c) { return c.holds && (c.is_exact || is_final || Method::IS_SINGLE); };
    int outcome = method.solve(d, to) ? CANDIDATE : NOTHING;
    Certificate found{false, 0};
    if (outcome) found = judged(d.compliance), outcome += accepts(found);
    const Certificate first = found;
    if (outcome < SOLUTION && method.search_softened(d, to)) {
      Real part = Method::LEAST_COMPLIANCE;
      auto is_solved = [&] { return method.solve_softened(d, to, part) && accepts(judged(method.COMPLIANCE + m)); };
      bool is_least = is_solved();
      while (!is_least && part < Method::LARGEST_COMPLIANCE / 2) part *= 10, is_least = is_solved();
      if (is_least) {
        method.extrapolate(d, to, part), found = judged(d.compliance);
        if (!accepts(found)) method.put_back(to);
      }
      if (is_least && accepts(found)) outcome = SOLUTION;
      else if (is_least && found.residual > kkt_tol && (is_final || contradicts(d, to.x))) outcome = LEAST_VIOLATION;
      else outcome = method.solve(d, to) ? CANDIDATE : NOTHING, found = first;  // from which a search goes on
    }
    t.once([&] { to.report[0] = outcome; });
    return found;
  }

  // x: [n], y: [p] multipliers of the rows, active: [n + p] labels; residuals up to kkt_tol are certified
  template <class Data>
  OSIK_CALL Certificate judge(const Data& d, const Real* x, const Real* y, const Int* active, Real kkt_tol) {
    t.are_shared(x, y, active);
    tolerance = d.tolerance;
    add_terms(d, x);
    measure();
    each_entry(t, n, [&](auto e) {
      auto gradient = e(GRADIENT), terms = decltype(gradient)(0);
      for (int q = 0; q < p; ++q) {
        const auto force = e(d.rows + q * ld) * y[q];
        gradient -= force, terms += fabs(force);
      }
      e.put(gradient, GRADIENT), e.put(terms, ROW_TERMS);
    });
    bool holds = true, exact = true;
    Gathered dual, primal, terms;
    each_entry(t, n, [&](auto e) {
      const auto multiplier = e(GRADIENT), at = e(x), free = fabs(multiplier);
      const auto size = e(SCALE) + e(ROW_TERMS), roundoff = EPS * size;
      const auto found = check(e, d.lower, d.upper, active, at, at, e(INVERSE_ROOT), decltype(at)(1), multiplier,
                               Real(ROW_MULTIPLIER) * e(ROW_TERMS), Method::RELEASE * roundoff);
      const auto beyond = select(found.inactive, free, found.sign), small = Real(GRADIENT_TOL) * roundoff;
      holds &= !any(
          !(found.holds & ((free <= Real(VALUE_TOL) * tolerance * found.force) | (free <= small) | !found.inactive)));
      exact &= !any(!(e.are(active, EQUALITY) | (beyond <= small)));
      terms.most(size), dual.most(select(found.one_side | found.inactive, beyond, decltype(at)(0)));
    });
    t.each(0, p, [&](int q) {
      const Real* row = d.rows + q * ld;
      const Real value = sums(row, x, n).value, curved = sums(row, INVERSE_ROOT, n).size, length = sums(row, ONES, n).size;
      const auto found = check(EntryOf<Team>{size_t(n + q)}, d.lower, d.upper, active, value, value + d.compliance[q] * y[q],
                               curved, length, y[q], Real(0), Real(0));
      holds = holds && found.holds && (!found.inactive || y[q] == 0) && is_finite(y[q]);
      Real longest = 0;
      for (int j = 0; j < n && found.one_side && found.sign > 0; ++j) {
        longest = larger(longest, Real(fabs(row[j])));
        const Real roundoff = Real(GRADIENT_TOL) * EPS * (SCALE[j] + ROW_TERMS[j]);
        holds = holds && (Method::IS_SINGLE || !(found.sign * fabs(row[j]) > roundoff));
      }
      dual.most(found.one_side ? found.sign * longest : Real(0));
      primal.most(larger(larger(found.gap, Real(0)), y[q] != 0 ? found.off : Real(0)) /
                  (found.scale > 0 ? found.scale : Real(1)));
    });
    const Real total = terms.largest(), residual = larger(dual.largest() / (total > 0 ? total : Real(1)), primal.largest());
    return {t.all(holds) && residual <= kkt_tol, residual, t.all(exact)};
  }

 private:
  // Whether what a point misses of hard rows proves that no point of the box satisfies them: is_farkas_certificate in
  // solvers/qp/_projected_newton.py.
  OSIK_CALL bool contradicts(const QPData<Real>& d, const Real* x) {
    constexpr Real ROUNDOFF = Method::IS_SINGLE ? SINGLE_FARKAS_ROUNDOFF : FARKAS_ROUNDOFF;
    Real* gap = FORCE;
    t.each(0, p, [&](int q) {
      Real value = 0;
      for (int j = 0; j < n; ++j) value += d.rows[q * n + j] * x[j];
      const Real low = d.lower[n + q], high = d.upper[n + q];
      gap[q] = d.compliance[q] > 0 ? Real(0) : value < low ? value - low : value > high ? value - high : Real(0);
    });
    const Real far = Real(FARKAS_RADIUS) * t.most(Real(0), 0, n, [&](int j, Real) {
      Real size = fabs(x[j]);
      for (const Real bound : {d.lower[j], d.upper[j]})
        size = fabs(bound) < Real(INFINITE) ? larger(size, Real(fabs(bound))) : size;
      return size;
    });
    // the most that the rows can still gain in the box
    const Real gain = t.sum(0, n, [&](int j) {
      Real slope = 0, terms = 0;
      for (int q = 0; q < p; ++q) {
        const Real term = d.rows[q * n + j] * gap[q];
        slope += term, terms += fabs(term);
      }
      const Real way = slope > 0 ? x[j] - d.lower[j] : d.upper[j] - x[j];
      return fabs(slope) <= ROUNDOFF * terms ? Real(0) : Real(fabs(slope)) * (way < Real(INFINITE) ? way : far);
    });
    return t.sum(0, p, [&](int q) { return square(gap[q]); }) > (1 + Real(FARKAS_MARGIN)) * gain;
  }
  OSIK_FN RowSums<Real> sums(const Real* row, const Real* x, int n) const { return row_sums(t, row, x, n); }
  // the cost's gradient at x, the sizes of its terms, and roots of its curvatures
  template <class Data> OSIK_CALL void add_terms(const Data& d, const Real* x) {
    t.are_shared(x);
    each_entry(t, n, [&](auto e) { e.put(fabs(e(x)), SIZE); });
    t.each(0, m, [&](int i) {
      const RowSums<Real> found = sums(d.matrix + i * ld, x, n);
      FORCE[i] = d.weight[i] * (found.value - d.target[i]), TERMS[i] = d.weight[i] * (found.size + fabs(d.target[i]));
    });
    t.each(n, Team::padded(n), [&](int j) { INVERSE_ROOT[j] = ONES[j] = 0; });
    each_entry(t, n, [&](auto e) {
      const auto damping = e(d.damping), center = e(d.center), one = decltype(damping)(1);
      auto gradient = damping * (e(x) - center), scale = damping * (e(SIZE) + fabs(center)), curvature = damping;
      OSIK_UNROLL_4
      for (int i = 0; i < m; ++i) {
        const auto entry = e(d.matrix + i * ld);
        gradient += entry * FORCE[i], scale += fabs(entry) * TERMS[i], curvature += d.weight[i] * (entry * entry);
      }
      const auto root = sqrt(select(curvature > Real(0), curvature, one));
      e.put(gradient, GRADIENT), e.put(scale, SCALE), e.put(root, ROOT), e.put(one / root, INVERSE_ROOT), e.put(one, ONES);
    });
  }
  // the sizes of x, or those of its Newton step by the curvatures alone where x is roundoff beside it
  OSIK_CALL void measure() {
    Gathered rooted, size, rooted_newton, newton;
    each_entry(t, n, [&](auto e) {
      const auto step = fabs(e(GRADIENT)) * e(INVERSE_ROOT) * e(INVERSE_ROOT);
      rooted.most(e(SIZE) * e(ROOT)), size.most(e(SIZE)), rooted_newton.most(step * e(ROOT)), newton.most(step);
    });
    const Real most = rooted.largest(), most_newton = rooted_newton.largest();
    const bool is_roundoff = most <= Real(ZERO_TOL) * EPS * most_newton;
    scaled = is_roundoff ? most_newton : most, plain = is_roundoff ? newton.largest() : size.largest();
  }
  template <class Number> struct Checked {
    using Which = decltype(Number() < Number());
    Which holds, one_side, inactive;
    Number force, sign, off, gap, scale;  // sign: the multiplier, if positive in the wrong direction; off: from its bound
  };
  // What all constraints have to be, and what is asked of their multipliers. release: a multiplier of
  // the wrong sign up to this is none.
  template <class E, class Number> OSIK_FN Checked<Number> check(E e, const Real* lower, const Real* upper,
                                                                 const Int* active, Number value, Number compliant,
                                                                 Number per_curvature, Number per_unit, Number multiplier,
                                                                 Number force_of_rows, Number release) const {
    using Which = typename Checked<Number>::Which;
    const Which at_lower = e.are(active, AT_LOWER), at_upper = e.are(active, AT_UPPER), redundant = e.are(active, REDUNDANT);
    const Which equality = e.are(active, EQUALITY), one_side = at_lower | at_upper,
                inactive = e.are(active, INACTIVE) | redundant;
    const Number low = e(lower), high = e(upper), from = fabs(low), to = fabs(high), nearest = select(from < to, from, to),
                 zero = 0;
    const Number scaled_reach = scaled * per_curvature, reach = plain * per_unit;
    const Number scale = select(scaled_reach < reach, scaled_reach, reach) + fabs(value) +
                         select(nearest < Real(INFINITE), nearest, zero);
    const Number curved = select(per_curvature < SMALLEST, Number(SMALLEST), per_curvature);
    const Number force = scale / (curved * curved) + force_of_rows, sign = select(at_lower, -multiplier, multiplier);
    const Number off = select(inactive, zero, fabs(compliant - select(at_upper, high, low)));
    const Number below = low - compliant, above = compliant - high, gap = select(above > below, above, below);
    const Number near = Real(VALUE_TOL) * tolerance * scale;
    const Which labelled = one_side | (equality & (low == high)) | (inactive & ((low != high) | redundant));
    const Which holds = labelled & (off <= near) & !(gap > select(redundant, REDUNDANT_TOL * near, near)) &
                        ((sign <= Real(SIGN_TOL) * tolerance * force) | (sign <= release) | !one_side);
    return {holds, one_side, inactive, force, sign, off, gap, scale};
  }
  static constexpr Real SMALLEST = sizeof(Real) == 8 ? 2.2250738585072014e-308 : 1.17549435e-38;
};
}  // namespace osik
