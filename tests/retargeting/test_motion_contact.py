"""What stands, of feet whose steps are known: with noise, at several rates."""

import numpy as np
import pytest

from osik_jax.retargeting._contact import HEIGHT, find_contact, find_ground, find_noise, noise_steps

RATES = (30.0, 60.0, 120.0)
STANCE, SWING, STRIDE, LIFT = 0.6, 0.4, 0.8, 0.12


def steps(fps, cycles=6):
    """Two feet, heel and toe each, that walk: where they are, and whether they stand by what a walk is made of."""
    time = np.arange(round(cycles * (STANCE + SWING) * fps)) / fps
    points, stands = np.zeros((len(time), 4, 3)), np.zeros((len(time), 4), bool)
    for foot in range(2):
        count, phase = np.divmod(time + 0.5 * foot * (STANCE + SWING), STANCE + SWING)
        share = np.clip((phase - STANCE) / SWING, 0.0, 1.0)
        along = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)  # least jerk
        for end in range(2):
            k = 2 * foot + end
            points[:, k, 0] = STRIDE * (count + along) + 0.2 * end
            points[:, k, 1] = 0.2 * foot
            points[:, k, 2] = 0.01 + LIFT * np.sin(np.pi * along) ** 2
            stands[:, k] = share == 0.0
    return points, stands


def plain(points, fps, ground, height=0.04, speed=0.3):
    """Low and slow in both steps, frame by frame."""
    out = np.zeros(points.shape[:2], bool)
    for f, k in np.ndindex(*out.shape):
        near = [g for g in (f - 1, f + 1) if 0 <= g < len(points)]
        rates = [np.linalg.norm(points[g, k] - points[f, k]) * fps for g in near]
        out[f, k] = points[f, k, 2] - ground < height and max(rates) < speed
    return out


@pytest.mark.parametrize("fps", RATES)
@pytest.mark.parametrize("noise", [0.002, 0.005, 0.01])
def test_standing_is_found_under_noise(fps, noise):
    points, truth = steps(fps)
    noisy = points + noise * np.random.default_rng(0).standard_normal(points.shape)
    found = find_noise(noisy)
    assert found == pytest.approx(noise, rel=0.15)
    ground = find_ground(noisy, noise_steps(found, fps))
    assert abs(ground - 0.01) < 0.25 * HEIGHT  # the lowest of four noisy points is lower than they are
    stands = find_contact(noisy, fps, ground, noise=found)
    # what moves slowly as it lands or leaves stands too, by its speed
    slow = plain(points, fps, 0.01) | truth
    assert (stands & truth).sum() > 0.9 * truth.sum()
    assert (stands & slow).sum() > 0.9 * stands.sum()
    # feet do not flicker: as many steps as there are
    assert abs(np.diff(stands.astype(int), axis=0) == 1).sum() <= 1.15 * (np.diff(truth.astype(int), axis=0) == 1).sum()


@pytest.mark.parametrize("fps", RATES)
def test_without_noise_it_is_low_and_slow_frame_by_frame(fps):
    points, truth = steps(fps)
    noise = find_noise(points)
    assert noise < 1e-6 and noise_steps(noise, fps) == 1
    stands = find_contact(points, fps, find_ground(points), noise=noise)
    inside = slice(None, -round(0.1 * fps))  # a step that the clip's end cuts off is too short to stand
    np.testing.assert_array_equal(stands[inside], plain(points, fps, find_ground(points))[inside])
    assert (stands & truth).sum() > 0.9 * truth.sum()


def test_the_noise_of_a_speed_is_that_of_a_line_through_its_window():
    rng, fps, noise = np.random.default_rng(1), 60.0, 0.01
    count = noise_steps(noise, fps)
    fits = np.polyfit(np.arange(count + 1) / fps, noise * rng.standard_normal((count + 1, 4000)), 1)[0]
    fewer = np.polyfit(np.arange(count) / fps, noise * rng.standard_normal((count, 4000)), 1)[0]
    assert fits.std() < 1.05 * 0.35 * 0.3 < 1.1 * fewer.std()


def test_clips_of_few_frames():
    one = np.zeros((1, 4, 3))
    assert find_noise(one) == 0.0 and not find_contact(one, 30.0, 0.0, noise=0.01).any()
    few = np.zeros((3, 4, 3))
    assert find_contact(few, 30.0, 0.0, noise=0.01).all()
