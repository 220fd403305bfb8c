"""Robot of the tests of retargeting."""

import pytest

import osik_jax as osik


@pytest.fixture(scope="session")
def nao():
    return osik.load_robot("nao")
