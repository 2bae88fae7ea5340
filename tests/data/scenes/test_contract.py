"""Every endless scene of ours passes the check that a plugin's must."""

import pytest

from mvrecon.testing import check_scene


@pytest.mark.parametrize("name", ["ellipsoids", "shepp_logan"])
def test_contract(name: str):
    check_scene(name)
