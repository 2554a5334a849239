"""Controllers as FMUs: FMPy finds them valid, and runs them with the bits of Python."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from helpers.c99 import WARNINGS
from helpers.channels import random_paths
from helpers.core import ran, tool, zig

from kfopc_filterpy import OutputLimiter, OutputPowerConstraint, Plant, fx_lms, kf_opc, kf_pb, simulate
from kfopc_filterpy.export import Float32Controller, export_fmu

fmpy = pytest.importorskip("fmpy", reason="needs FMPy (the extra `fmu`)")
for part in ("fmpy.fmi3", "fmpy.validation"):
    pytest.importorskip(part)
pytest.importorskip("ziglang", reason="zig compiles for both systems")
pytestmark = pytest.mark.slow  # zig compiles for two systems
FS, SAMPLES = 8000, 2000
ONE = Plant([0.0, 0.8, 0.3, -0.1], [0, 0, 0, 0, 1.0], fs=FS)
TWO = Plant(random_paths(2, 2, 4, seed=1), random_paths(2, 2, 12, seed=2, delay=4), fs=FS)
NOISES = {"state_noise": 1e-7, "measurement_noise": 1e-2}
CONTROLLERS = {
    "FxLMS": lambda: fx_lms(16, ONE, step_size=1e-3),
    "KF-OPC": lambda: kf_opc(
        16, ONE, constraint=OutputPowerConstraint(0.3, fs=FS), limiter=OutputLimiter(0.3, fs=FS), **NOISES
    ),
    "KF-PB": lambda: kf_pb(8, TWO, rated_power=[0.3, 0.2], n_references=2),
}


class Unit:
    """A unit that FMPy runs, as a controller of `simulate`: the error is an input of the next step."""

    def __init__(self, path):
        self.described, self.folder = fmpy.read_model_description(str(path)), fmpy.extract(str(path))
        self.at = {variable.name: variable.valueReference for variable in self.described.modelVariables}
        self.number = self.described.modelVariables[0].type
        self.slave = self.opened()
        self.time, self.error = 0.0, []

    def opened(self, token=None):
        slave = fmpy.fmi3.FMU3Slave(
            guid=token or self.described.guid,
            unzipDirectory=self.folder,
            modelIdentifier=self.described.coSimulation.modelIdentifier,
            instanceName="unit",
        )
        slave.instantiate(logMessage=self.log)
        slave.enterInitializationMode()
        slave.exitInitializationMode()
        return slave

    def log(self, environment, status, category, message):
        self.logged = message.decode()

    def named(self, what):
        return [vr for name, vr in self.at.items() if name.split("[")[0] == what]

    def control_signal(self, reference):
        put, get = getattr(self.slave, f"set{self.number}"), getattr(self.slave, f"get{self.number}")
        put(self.named("reference"), np.ravel(reference).tolist())
        if len(self.error):
            put(self.named("error"), self.error)
        self.slave.doStep(self.time, 1 / FS)
        self.time += 1 / FS
        y = get(self.named("control_signal"))
        return np.array(y) if np.ndim(reference) else y[0]

    def update(self, error):
        self.error = np.ravel(error).tolist()

    def close(self):
        self.slave.freeInstance()
        shutil.rmtree(self.folder)


@pytest.fixture(scope="module")
def units(tmp_path_factory):
    """Return a function that makes a unit of a controller's name and precision, each once."""
    made = {}

    def unit(name, dtype):
        if (name, dtype) not in made:
            path = tmp_path_factory.mktemp("units") / "anc.fmu"
            made[name, dtype] = export_fmu(CONTROLLERS[name](), path, fs=FS, dtype=dtype)
        return made[name, dtype]

    return unit


@pytest.fixture
def opened(units):
    """Return a function that opens a unit, which is closed after the test."""
    running = []

    def open_unit(name="KF-OPC", dtype="float64"):
        running.append(Unit(units(name, dtype)))
        return running[-1]

    yield open_unit
    for one in running:
        one.close()


def run(controller, several=False, samples=SAMPLES):
    x = np.random.default_rng(0).standard_normal((2, samples))
    return simulate(controller, x, TWO) if several else simulate(controller, x[0], ONE)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_unit_is_valid_and_has_the_bits_of_python_on_the_plant_of_simulate(name, dtype, units, opened):
    assert fmpy.validation.validate_fmu(str(units(name, dtype))) == []
    controller = CONTROLLERS[name]()
    several = controller.multichannel
    result = run(opened(name, dtype), several)
    expected = run(controller if dtype == "float64" else Float32Controller(controller), several)
    np.testing.assert_array_equal(result.control_signal, expected.control_signal)
    np.testing.assert_array_equal(result.error, expected.error)
    assert np.std(result.control_signal) > 0.05


@pytest.mark.parametrize("way", ["restored", "serialized"])
def test_a_state_that_is_restored_goes_on_to_the_bit(way, opened):
    unit = opened()
    x, e = np.random.default_rng(1).standard_normal((2, 2, 1000))

    def run_on():
        y = []
        for xn, en in zip(*x if unit.time else e, strict=True):
            y.append(unit.control_signal(xn))
            unit.update(en)
        return y

    begun = run_on()
    state, then = unit.slave.getFMUState(), (unit.time, unit.error)
    first = run_on()
    if way == "restored":
        unit.slave.setFMUState(state)
    else:
        saved = unit.slave.serializeFMUState(state)
        unit.slave.freeInstance()
        unit.slave = unit.opened()
        unit.slave.setFMUState(unit.slave.deserializeFMUState(saved))
    unit.time, unit.error = then
    assert run_on() == first
    unit.slave.reset()
    unit.time, unit.error = 0.0, []
    assert run_on() == begun


def test_what_a_unit_cannot_do_is_refused_and_logged(opened):
    unit = opened()
    unit.control_signal(1.0)
    cases = {
        "a step must be a sample, 0.000125 s": lambda: unit.slave.doStep(unit.time, 2 / FS),
        "there is no such Float64": lambda: unit.slave.getFloat64([99]),
        "only references and errors can be set": lambda: unit.slave.setFloat64([unit.at["control_signal"]], [1.0]),
        "there is no such Int32": lambda: unit.slave.getInt32([1]),
        "fmi3GetBoolean is not supported": lambda: unit.slave.getBoolean([1]),
        "fmi3EnterEventMode is not supported": unit.slave.enterEventMode,
        "a serialized state has another size": lambda: unit.slave.deserializeFMUState(b"short"),
        "the token is that of another unit, or no memory is left": lambda: unit.opened("another"),
    }
    for message, call in cases.items():
        with pytest.raises(Exception, match=r"failed with status 3|Failed to instantiate"):
            call()
        assert unit.logged == message
    unit.update(np.nan)
    unit.control_signal(1.0)
    assert unit.slave.getInt32([unit.at["answer"]]) == [2]  # LOUD_ERROR


def test_an_output_depends_on_no_input_of_the_same_moment(opened):
    unit = opened()
    for unknown in (*unit.described.outputs, *unit.described.initialUnknowns):
        assert unknown.dependencies == []


@pytest.mark.parametrize("command", ["gcc", "clang"])
def test_the_sources_compile_as_their_description_says(command, opened):
    unit = opened("KF-PB", "float32")
    sources = f"{unit.folder}/sources"
    described = ElementTree.parse(f"{sources}/buildDescription.xml").find(".//SourceFileSet")
    files = [f"{sources}/{one.get('name')}" for one in described]
    flags = [*described.get("compilerOptions").replace("-O3", "-O0").split(), *WARNINGS, "-fPIC", "-shared"]
    ran(tool(command), *flags, *files, "-lm", "-o", f"{unit.folder}/binaries/x86_64-linux/anc.so")
    unit.slave.freeInstance()
    unit.slave = unit.opened()
    expected = run(Float32Controller(CONTROLLERS["KF-PB"]()), True, 300)
    np.testing.assert_array_equal(run(unit, True, 300).control_signal, expected.control_signal)


def test_the_same_controller_gives_the_same_file(tmp_path):
    one, two = (export_fmu(CONTROLLERS["FxLMS"](), tmp_path / folder, fs=FS) for folder in ("a.fmu", "b.fmu"))
    (tmp_path / "c").mkdir()
    again = export_fmu(CONTROLLERS["FxLMS"](), tmp_path / "c" / "a.fmu", fs=FS)
    assert one.read_bytes() == again.read_bytes() != two.read_bytes()


def test_the_library_for_windows_has_the_bits_of_python(opened, tmp_path):
    """A small host loads it, in wine. The error is an input of the next step."""
    wine, unit = tool("wine"), opened()
    host, sources = Path(__file__).with_name("windows_host.c"), f"{unit.folder}/sources"
    ran(*zig(), "-target", "x86_64-windows-gnu", "-I", sources, host, "-o", tmp_path / "host.exe")
    result = run(CONTROLLERS["KF-OPC"]())
    stream = np.stack([result.reference, np.r_[0.0, result.error[:-1]]], axis=1)
    library = f"{unit.folder}/binaries/x86_64-windows/anc.dll"
    done = subprocess.run(
        [wine, str(tmp_path / "host.exe"), library, unit.described.guid],
        input=stream.tobytes(),
        capture_output=True,
        env=os.environ | {"WINEDEBUG": "-all", "WINEPREFIX": str(tmp_path / "prefix")},
    )
    assert done.returncode == 0
    np.testing.assert_array_equal(np.frombuffer(done.stdout), result.control_signal)
