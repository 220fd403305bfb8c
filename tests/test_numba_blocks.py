"""Sums and factors in blocks, which Numba's kernels are made of, beside NumPy."""

import numpy as np
import pytest

pytest.importorskip("numba")


def test_sums_and_factors_in_blocks_are_those_of_numpy():
    """Of every size up to three blocks, in matrices that are wider; what is behind them comes into nothing."""
    import numba

    from osik_jax.kernels.numba import _padded_rows, _symmetric, _transpose

    @numba.njit
    def solved_by_blocks(S, L, T, inverse, diagonal, b, n):
        sound = _symmetric.factor_symmetric(S, L, T, inverse, diagonal, n, 1e-14)
        _symmetric.solve_symmetric(L, T, inverse, b, n)
        return sound

    @numba.njit
    def summed(out, base, a, B, first, last, start, stop, kind):
        if kind == 0:
            _padded_rows.plus_rows(out, base, a, B, first, last, start, stop)
        elif kind == 1:
            _padded_rows.minus_rows(out, base, a, B, first, last, start, stop)
        elif kind == 2:
            _padded_rows.plus_sizes(out, base, a, B, first, last, start, stop)
        else:
            _padded_rows.plus_squares(out, base, a, B, first, last, start, stop)

    @numba.njit
    def others(T, B, u, v, c):
        _transpose.transpose(T, B, 13, 35)
        _padded_rows.add_to_rows(B, u, v, 2, 7, 8, 40)
        _padded_rows.put_multiple(c, 3.0, v, 35)
        return _padded_rows.largest_product(v, v, 40)

    rng, wide = np.random.default_rng(0), 32
    for n in range(1, 25):
        rows = rng.normal(size=(n, n + 2))
        S, b, end = np.full((wide, wide), np.nan), np.full(wide, np.nan), -(-n // 8) * 8
        S[:end, :end], b[:n] = 0.0, rng.normal(size=n)
        S[:n, :n] = rows @ rows.T
        expected = np.linalg.solve(S[:n, :n], b[:n])
        L, T, inverse, diagonal = (np.full(shape, np.nan) for shape in ((wide, wide), (wide, wide), wide, wide))
        assert solved_by_blocks(S, L, T, inverse, diagonal, b, n)
        np.testing.assert_allclose(b[:n], expected, rtol=1e-6)
    bad = np.diag([1.0, 1e-16, -1.0, *[1.0] * 5])
    bad[0, 1] = bad[1, 0] = 1e-8
    assert not solved_by_blocks(bad, L, T, inverse, diagonal, b, 3)
    for blocks in range(1, 13):
        B, a, base = rng.normal(size=(9, 8 * blocks)), rng.normal(size=9), rng.normal(size=8 * blocks)
        some, factors = B[2:7], a[2:7]
        sums = factors @ some, -factors @ some, np.abs(factors) @ np.abs(some), np.sum(some**2, 0)
        for start in {0, 8 * (blocks // 2)}:
            for kind, total in enumerate(sums):
                out = np.zeros(8 * blocks)
                summed(out, base, a, B, 2, 7, start, 8 * blocks, kind)
                np.testing.assert_allclose(out[start:], (base + total)[start:], atol=1e-12)
                assert (out[:start] == 0.0).all()
    B, T, u, v, c = (
        rng.normal(size=(16, 40)),
        np.zeros((40, 16)),
        rng.normal(size=16),
        rng.normal(size=40),
        np.zeros(40),
    )
    before = B.copy()
    assert others(T, B, u, v, c) == np.max(v**2)
    np.testing.assert_array_equal(T[:35, :13], before.T[:35, :13])
    before[2:7, 8:] += u[2:7, None] * v[None, 8:]
    np.testing.assert_allclose(B, before, atol=1e-14)
    np.testing.assert_array_equal(c, np.append(3.0 * v[:35], np.zeros(5)))
