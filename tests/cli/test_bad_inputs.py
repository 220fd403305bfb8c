"""Wrong inputs: each gets an exception of ours, or a status, and the page says which."""

import warnings

import pytest

from benchmarks import bad_inputs

OUTCOMES: dict[str, str] = {}
"""By what is given; filled by the cases, compared with the page in the end."""


def test_every_input_has_a_name_of_its_own_and_they_are_many():
    given = [case.given for case in bad_inputs.cases()]
    assert len(set(given)) == len(given) >= 150


@pytest.mark.parametrize("number", range(len(bad_inputs.cases())), ids=lambda n: bad_inputs.cases()[n].given)
def test_outcome(number):
    case = bad_inputs.cases()[number]
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        OUTCOMES[case.given] = bad_inputs.outcome(case)


def test_the_page_says_so():
    missing = [case for case in bad_inputs.cases() if case.given not in OUTCOMES]
    outcomes = OUTCOMES | {case.given: bad_inputs.outcome(case) for case in missing}
    text = bad_inputs.PAGE.read_text(encoding="utf-8")
    assert text == bad_inputs.page(outcomes), "python -m benchmarks.bad_inputs --write"
