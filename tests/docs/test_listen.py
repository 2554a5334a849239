"""The page that plays: what its loop computes, and what a browser makes of it."""

from __future__ import annotations

import base64
import ctypes
import json
import re
import struct
import subprocess
import sys

import numpy as np
import pytest
import soundfile
from helpers.core import c_compiler
from helpers.pages import ROOT

from kfopc_filterpy import HardClipAmplifier, Plant, fx_nlms, kf_anc, kf_opc, kf_pb, simulate
from kfopc_filterpy.core.building import FLAGS, FOLDER

sys.path.insert(0, str(ROOT / "docs" / "extensions"))
import listening

SECONDS, LEVEL_DB = 5, 6.0
BUFFERS = ("primary", "secondary", "settings", "noise", "error")
SCENE = listening.scene()
NOISE = np.frombuffer(base64.b64decode(SCENE["noise"]), "<i2") / 32768.0


def wav(block, bits, samples=bytes(range(200))):
    """Return a WAV file of two channels at 8 kHz, whatever its header says."""
    header = struct.pack("<4sIHHIIHH4sI", b"fmt ", 16, 1, 2, 8000, 8000 * block, block, bits, b"data", len(samples))
    return b"RIFF" + struct.pack("<I", 4 + len(header) + len(samples)) + b"WAVE" + header + samples


class Native:
    """The page's loop as a library of this machine."""

    def __init__(self, folder, real):
        library, flags = folder / f"{real}.so", [flag for flag in FLAGS if not flag.startswith("-fvisibility")]
        flags += ["-fPIC", f"-I{FOLDER}", *(["-DANC_FLOAT"] if real == "float" else [])]
        subprocess.run([*c_compiler(), *flags, *listening.sources(), "-lm", "-o", library], check=True)
        self.library = ctypes.CDLL(str(library))
        self.real = ctypes.c_float if real == "float" else ctypes.c_double
        self.library.player_buffer.restype = ctypes.POINTER(self.real)

    def buffer(self, name, size):
        return np.ctypeslib.as_array(self.library.player_buffer(BUFFERS.index(name)), (size,))

    def errors(self, scene, x):
        """Return the errors of a scene, block by block as a browser asks for them."""
        for name in ("primary", "secondary", "settings"):
            self.buffer(name, len(scene[name]) or 1)[: len(scene[name])] = scene[name]
        lengths, numbers = (
            (scene["taps"], len(scene["primary"]), len(scene["secondary"])),
            (scene["rated"], scene["rate"]),
        )
        assert self.library.player_open(scene["which"], *lengths, *map(self.real, numbers), 1)
        errors = []
        for block in np.split(x, range(128, x.size, 128)):
            self.buffer("noise", block.size)[:] = block
            self.library.player_run(block.size)
            errors.append(self.buffer("error", block.size).copy())
        return np.concatenate(errors)


@pytest.fixture(scope="module")
def double(tmp_path_factory):
    return Native(tmp_path_factory.mktemp("double"), "double")


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    return Native(tmp_path_factory.mktemp("single"), "float")


@pytest.mark.parametrize("name", SCENE["controllers"])
def test_the_loop_is_that_of_simulate(name, double):
    x, rated, fs = NOISE[:6000], 0.2, float(SCENE["fs"])
    primary, secondary = np.array(SCENE["primary"]), np.array(SCENE["secondary"])
    noises = {"state_noise": 1e-9, "measurement_noise": 1e-3, "initial_variance": 0.01}
    controller = {
        "plain Kalman filter": lambda: kf_anc(128, secondary, **noises),
        "KF-OPC": lambda: kf_opc(128, secondary, rated_power=rated, fs=fs, **noises),
        "KF-PB": lambda: kf_pb(128, secondary, rated_power=rated, fs=fs),
        "FxNLMS": lambda: fx_nlms(128, secondary, step_size=0.01),
        "off": lambda: None,
    }[name]()
    settings = list(listening.settings_of(controller).values()) if controller else []
    scene = SCENE | SCENE["controllers"][name] | {"settings": settings, "taps": 128, "rated": rated}
    played = double.errors(scene | {"rate": SCENE["rates"][SCENE["fs"]]["rate"]}, x)
    d = np.convolve(x, primary)[: x.size]
    if controller is None:
        np.testing.assert_allclose(played, d, rtol=0, atol=1e-13)  # another order of the sums
        return
    d = double.errors(scene | {"which": 0, "settings": [], "rate": 1.0}, x)
    amplifier = HardClipAmplifier(2 * rated**0.5)
    plant = Plant(secondary, amplifier=amplifier, fs=fs)
    expected = simulate(controller, x, plant, disturbance=d)
    assert np.array_equal(played, expected.error)


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    """The page as a file, with its script beside it."""
    folder = tmp_path_factory.mktemp("listen")
    pytest.importorskip("ziglang", reason="needs zig: python -m pip install ziglang")
    listening.write_script(folder)
    text = (ROOT / "docs" / "listen.md").read_text(encoding="utf-8")
    (body,) = re.findall(r"```\{raw\} html\n(.*?)```", text, re.S)
    head = '<!doctype html><meta charset=utf-8><meta name="viewport" content="width=device-width">'
    (folder / "page.html").write_text(head + body.replace("_static/", ""), encoding="utf-8")
    return (folder / "page.html").as_uri()


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENE["controllers"])
def test_a_browser_plays_the_bits_of_this_machine(name, page, browser, single):
    browser.get(page)
    asked = f"{json.dumps(name)}, {LEVEL_DB}"
    rendered = browser.execute_async_script(
        f"const done = arguments[0]; kfopcListen.render({asked}, {SECONDS}).then((x) => done(Array.from(x)), (e) => done(String(e)));"
    )
    scene = browser.execute_script(f"return kfopcListen.sceneOf({asked})")
    for given in ("primary", "secondary", "settings"):
        values = scene[given]
        scene[given] = list(values.values()) if isinstance(values, dict) else values
    x = NOISE[: SECONDS * SCENE["fs"]].astype(np.float32)
    expected = single.errors(scene, x)
    assert np.array_equal(np.array(rendered, np.float32), expected)
    assert np.std(expected[-8000:]) > 0


SETTLED = {
    "off": lambda less, power: less == power == 0.0,
    "plain Kalman filter": lambda less, power: power > 5,
    "KF-OPC": lambda less, power: less > 4 and 0.7 < power < 1.3,
    "KF-PB": lambda less, power: less > 4 and 0.7 < power < 1.3,
    "FxNLMS": lambda less, power: power > 0,
}


@pytest.mark.slow
def test_the_page_is_played_and_says_what_it_does(page, browser):
    """The noise reduction in dB and the power over the rated one, of the last second, after some seconds."""
    browser.get(page)
    said = browser.find_element("id", "listen-said")
    browser.find_element("id", "listen-play").click()
    assert set(SETTLED) == set(SCENE["controllers"])
    for name, settled in SETTLED.items():
        browser.find_element("css selector", f'input[value="{name}"]').click()
        numbers = lambda: [float(number) for number in re.findall(r"(-?[\d.]+) (?:dB|of)", said.text)]  # noqa: E731
        browser.until(lambda _: len(numbers()) == 2 and settled(*numbers()))  # noqa: B023
    browser.find_element("id", "listen-play").click()
    assert not [entry for entry in browser.get_log("browser") if entry["level"] == "SEVERE"]


@pytest.mark.slow
@pytest.mark.parametrize("width", [390, 1300])
def test_the_page_fits_a_phone_and_a_screen(width, page, browser):
    """Nothing is wider than the window, the button comes first, and the drawing's words are at least 11 pixels high."""
    shape = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", shape)
    try:
        browser.get(page)
        assert browser.execute_script("return document.documentElement.scrollWidth") <= width
        button, controls, word = (
            browser.execute_script("return document.querySelector(arguments[0]).getBoundingClientRect()", which)
            for which in ("#listen-play", "#listen-controls", "#listen svg text")
        )
        assert 0 < button["bottom"] <= controls["top"] < 900
        assert word["height"] > 11
        one_line = controls["height"] < 60
        assert one_line == (width == 1300)
    finally:
        browser.execute_cdp_cmd("Emulation.clearDeviceMetricsOverride", {})


@pytest.mark.slow
@pytest.mark.parametrize("subtype", ["PCM_16", "PCM_24", "PCM_32", "FLOAT", "DOUBLE"])
def test_a_file_is_read_as_it_is(subtype, page, browser, tmp_path):
    x = np.random.default_rng(1).uniform(-0.9, 0.9, (100, 2))
    soundfile.write(tmp_path / "x.wav", x, 11025, subtype=subtype)
    expected, fs = soundfile.read(tmp_path / "x.wav", dtype="float32")
    browser.get(page)
    sent = base64.b64encode((tmp_path / "x.wav").read_bytes()).decode()
    given = browser.execute_script(
        "const file = kfopcListen.readWav(Uint8Array.from(atob(arguments[0]), (c) => c.charCodeAt(0)).buffer, 'x.wav');"
        "return [file.fs, Array.from(file.samples)]",
        sent,
    )
    assert given[0] == fs
    assert np.array_equal(np.array(given[1], np.float32), expected[:, 0])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"RIFF" + bytes(60), "no WAV file"),
        (wav(block=8, bits=24), "24 bits in blocks of 8 bytes are not read here"),
        (wav(block=4, bits=16, samples=bytes(400)), "empty, silent or not finite"),
    ],
)
def test_a_file_that_is_not_read_says_why(content, says, page, browser):
    browser.get(page)
    said = browser.execute_script(
        "try { kfopcListen.readWav(Uint8Array.from(atob(arguments[0]), (c) => c.charCodeAt(0)).buffer, 'x.wav') }"
        "catch (error) { return error.message }",
        base64.b64encode(content).decode(),
    )
    assert said.startswith("x.wav: ")
    assert says in said
