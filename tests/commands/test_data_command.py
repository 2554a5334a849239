"""`kfopc data`."""

from __future__ import annotations

import json


def test_the_measured_data_are_listed_and_an_unknown_name_is_refused(command, tmp_path):
    code, out, _ = command("data", "list", "--folder", tmp_path, "--json")
    assert code == 0
    facts = json.loads(out)
    assert facts["duct"]["fs"] == 16000
    assert facts["duct"]["here"] is False
    assert facts["duct"]["licence"]
    code, out, _ = command("data", "where", "--folder", tmp_path)
    assert (code, out.strip()) == (0, str(tmp_path))
    code, _, err = command("data", "fetch", "fan")
    assert code == 2
    assert "there is no data set 'fan'; there are duct" in err


def test_a_folder_of_data_that_is_named_but_does_not_exist_is_said(command, tmp_path, data_folder):
    data_folder(tmp_path / "nowhere")
    code, _, err = command("data", "list")
    assert code == 0
    assert f"the folder {tmp_path / 'nowhere'} does not exist: correct --folder or KFOPC_DATA" in err
    assert command("data", "list", "--folder", tmp_path)[2] == ""
