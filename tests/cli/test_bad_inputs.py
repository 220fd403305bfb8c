"""Each wrong input gets an exception of ours or a status, and the table in docs/dev has it."""

import pytest
from refusals import no_warnings

from benchmarks import bad_inputs
from benchmarks.data_file import read_csv

OUTCOMES: dict[str, str] = {}
"""Outcome of each input; filled by the cases, compared with the table at the end."""


def test_every_input_has_a_name_of_its_own_and_they_are_many():
    given = [case.given for case in bad_inputs.cases()]
    assert len(set(given)) == len(given) >= 150


@pytest.mark.parametrize("number", range(len(bad_inputs.cases())), ids=lambda n: bad_inputs.cases()[n].given)
def test_outcome(number):
    case = bad_inputs.cases()[number]
    with no_warnings(UserWarning):
        OUTCOMES[case.given] = bad_inputs.outcome(case)


def test_the_table_has_these_outcomes():
    missing = [case for case in bad_inputs.cases() if case.given not in OUTCOMES]
    outcomes = OUTCOMES | {case.given: bad_inputs.outcome(case) for case in missing}
    wanted = bad_inputs.HEAD, bad_inputs.table(outcomes)
    assert read_csv(bad_inputs.TABLE) == wanted, "python -m benchmarks.bad_inputs --write"
