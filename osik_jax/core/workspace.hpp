// How a method lays out its workspace, in the memory of a CPU or the shared memory of a warp: vectors of numbers, matrices,
// then vectors of integers. A method has
//
//   VECTORS, width(s)   how many vectors of numbers there are, and the places of a vector of numbers or integers
//   MATRICES            how many matrices there are, and
//   numbers_of(k, s)    the numbers of matrix k
//   size_of(k, s)       a number that depends on the sizes s of its problems
//
// and the members `space` and `size`, its memory and its sizes.
#pragma once
#include "linear_algebra.hpp"

namespace osik {

template <class Method, class Team, class Sizes> struct Workspace {
  using Real = typename Team::Real;
  using Int = typename Team::Int;
  static constexpr OSIK_HOST int numbers_before(int matrix, const Sizes& s) {
    int count = Method::VECTORS * Method::width(s);
    for (int k = 0; k < matrix; ++k) count += Method::numbers_of(k, s);
    return count;
  }
  static constexpr OSIK_HOST int bytes(const Sizes& s, int integers) {
    return (MatrixAt<Method::MATRICES>::of(s) + integers * int(sizeof(Int)) + 15) / 16 * 16;
  }
  // where arrays begin, in bytes
  template <int K> struct VectorAt {
    static constexpr OSIK_HOST int of(const Sizes& s) { return int(sizeof(Real)) * K * Method::width(s); }
  };
  template <int K> struct MatrixAt {
    static constexpr OSIK_HOST int of(const Sizes& s) { return int(sizeof(Real)) * numbers_before(K, s); }
  };
  template <int K> struct LabelsAt {
    static constexpr OSIK_HOST int of(const Sizes& s) {
      return MatrixAt<Method::MATRICES>::of(s) + int(sizeof(Int)) * K * Method::width(s);
    }
  };
  template <int K> struct SizeAt {
    static constexpr OSIK_HOST int of(const Sizes& s) { return Method::size_of(K, s); }
  };
  template <class At> using ArrayAt = typename Team::template Array<Real, At, Sizes>;
  template <int K> using Numbers = ArrayAt<VectorAt<K>>;
  template <int K> using Matrix = ArrayAt<MatrixAt<K>>;
  template <int K> using Labels = typename Team::template Array<Int, LabelsAt<K>, Sizes>;
  template <int K> using Size = typename Team::template Fixed<SizeAt<K>, Sizes>;
};

// OSIK_PLACED(Numbers, 3, A, B) declares the members A and B, vectors 3 and 4 of the workspace; likewise of Matrix, Labels
// and Size, for up to 25 names. A macro does not expand itself, so that the next name waits for another scan.
#define OSIK_PLACED(kind, first, ...) OSIK_SCAN_25(OSIK_PLACED_FROM(kind, first, __VA_ARGS__))
#define OSIK_PLACED_FROM(kind, at, name, ...)                        \
  typename Space::template kind<(at)> name{this->space, this->size}; \
  __VA_OPT__(OSIK_PLACED_NEXT OSIK_PARENTHESES(kind, (at) + 1, __VA_ARGS__))
#define OSIK_PLACED_NEXT() OSIK_PLACED_FROM
#define OSIK_PARENTHESES ()
#define OSIK_SCAN_25(...) OSIK_SCAN_5(OSIK_SCAN_5(OSIK_SCAN_5(OSIK_SCAN_5(OSIK_SCAN_5(__VA_ARGS__)))))
#define OSIK_SCAN_5(...) OSIK_SCAN(OSIK_SCAN(OSIK_SCAN(OSIK_SCAN(OSIK_SCAN(__VA_ARGS__)))))
#define OSIK_SCAN(...) __VA_ARGS__

}  // namespace osik
