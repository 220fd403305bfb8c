"""The warning before a process has as many memory maps as the system allows."""

import warnings
from pathlib import Path
from typing import Any

import pytest

import osik_jax as osik
from osik_jax.execution import _memory_maps as maps


def test_maps_are_counted_as_the_system_lists_them():
    count = maps.counted_maps()
    listing = Path("/proc/self/maps")
    lines = len(listing.read_text().splitlines()) if listing.exists() else None
    assert count == lines or (count and lines and abs(count - lines) < 20)


class Compiled:
    """Stands for a compiled function with so many programs."""

    def __init__(self, programs: int):
        self.programs = programs

    def _cache_size(self) -> int:
        return self.programs


def test_it_warns_once_where_few_are_left_and_counts_at_new_programs_alone(monkeypatch):
    counts: list[int] = []

    def counted() -> int:
        counts.append(0)
        return 600 + 100 * len(counts)

    monkeypatch.setattr(maps, "counted_maps", counted)
    monkeypatch.setattr(maps, "_most_maps", lambda: 1000)
    monkeypatch.setattr(maps, "_seen", {})
    monkeypatch.setattr(maps, "_warned", [])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        maps.watch_memory_maps("solve", Compiled(1))  # 700 of 1000
        maps.watch_memory_maps("solve", Compiled(1))
    assert len(counts) == 1
    with pytest.warns(osik.OsikWarning, match=r"800 of the 1000 memory maps.*jax\.clear_caches"):
        maps.watch_memory_maps("solve", Compiled(2))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        maps.watch_memory_maps("solve", Compiled(3))  # 900 of 1000
    maps.watch_memory_maps("solve", Compiled(1))  # caches were cleared, and programs are compiled again
    maps.watch_memory_maps("solve", Compiled(2))
    assert len(counts) == 5


@pytest.mark.slow
def test_solve_and_rollout_report_their_programs(monkeypatch):
    seen: dict[str, Any] = {}
    for module in ("_step", "_rollout"):
        target = f"osik_jax.control.{module}.watch_memory_maps"
        monkeypatch.setattr(target, lambda name, compiled: seen.__setitem__(name, compiled._cache_size()))
    arm = osik.load_robot("arm7")
    tasks = {"p": osik.PostureTask(arm)}
    osik.solve(arm, arm.q0, tasks, scheme=osik.WeightedQP(backend="jax"))  # a step of the core is no program
    osik.rollout(arm, arm.q0, tasks, steps=1)
    assert seen["solve"] >= 1 and seen["rollout"] >= 1
