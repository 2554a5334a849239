"""What a page shows: figures with words in their place, tables, sounds of one scale."""

from __future__ import annotations

import matplotlib.pyplot as plt
import numpy as np
import pytest

from kfopc_filterpy.signals import read_recording
from kfopc_filterpy.verdict.items import FigureItem, Sound, Table, loudness, write_files

D = np.sin(np.arange(400) / 3)


def test_figures_held_for_the_report_are_unknown_to_pyplot():
    plt.close("all")  # those that tests before this one have left
    for i in range(25):  # pyplot warns from 21 open figures on
        FigureItem(f"f{i}", "", plt.subplots()[0])
    assert not plt.get_fignums()


def test_a_residual_far_louder_than_the_first_sound_does_not_silence_it(tmp_path):
    (first, second), full_scale = loudness([D, 1e6 * D])
    assert full_scale == pytest.approx(4.0 * np.abs(D).max())
    np.testing.assert_array_equal(first, D)
    assert np.abs(second).max() == full_scale  # clipped
    write_files(tmp_path, "page", fs=8000.0, sounds=[Sound("first", "", D), Sound("second", "", 1e6 * D)])
    written = read_recording(tmp_path / "audio" / "page-first.wav").samples
    assert np.max(np.abs(written)) == pytest.approx(0.25, abs=1e-3)
    assert loudness([0 * D])[1] == 1.0


def test_a_table_for_the_terminal_aligns_numbers_to_the_right():
    table = Table("powers", "Powers", ["paths", "power"], [["duct", 0.123456789], ["band-pass", np.nan]])
    assert table.lines == ["paths       power", "duct       0.1235", "band-pass       –"]
