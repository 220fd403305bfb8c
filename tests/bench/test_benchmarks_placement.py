"""The cases of ``benchmarks.placement``, judged by Pinocchio and coal on the true collision meshes."""

import pytest

from benchmarks.placement import CASES, measure
from osik_jax.core import _library

pytestmark = [
    pytest.mark.skipif(not _library.installed(), reason="no compiled core"),
    pytest.mark.variants(slow=[name for name in CASES if "Panda" in name], release=[n for n in CASES if "TIAGo" in n]),
]


@pytest.mark.parametrize(("name", "reached"), [*zip(CASES, (50, 50, 19), strict=True)], ids=list(CASES))
def test_the_judge_confirms_each_base(name, reached):
    found, figures = measure(CASES[name])
    assert found.is_reached.sum() == reached
    assert figures["position error"] < 1e-3 and figures["orientation error"] < 1e-2
    assert figures["distance to the scene"] > 0.0 and figures["distance of own parts"] > 0.0
    assert figures["second call, processor"] < 10.0  # half of that where nothing else runs
