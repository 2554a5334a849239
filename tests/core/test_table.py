"""The tests of the core know every algorithm that it exports."""

from __future__ import annotations

from helpers.core import ALGORITHMS, exported, known

from kfopc_filterpy.core.block import Algorithm


def test_every_algorithm_is_known() -> None:
    assert known()


def test_settings_are_in_the_order_of_the_c_file() -> None:
    for name in exported():
        assert name in ALGORITHMS, (
            f"ALGORITHMS of tests/helpers/core.py does not know {name}: enter it with its settings"
        )
        assert [one.name for one in Algorithm(name).settings] == list(ALGORITHMS[name])
