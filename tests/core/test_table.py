"""The tests of the core know every algorithm that it exports."""

from __future__ import annotations

from helpers.core import ALGORITHMS, known

from kfopc_filterpy.core.block import Algorithm


def test_settings_are_in_the_order_of_the_c_file() -> None:
    for name in known():
        assert [one.name for one in Algorithm(name).settings] == list(ALGORITHMS[name])
