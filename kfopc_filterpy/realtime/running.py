"""A run in real time: identify the plant, check it, fade in, control, fade out, report."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import dataclass, field
from functools import partial
from inspect import signature
from typing import Any

import numpy as np

from .._types import PerLoudspeaker
from .._validate import as_count, as_nonnegative, as_positive, per_loudspeaker
from ..bounds.power_constrained import record_of_any
from ..bounds.prediction import predictor_reference
from ..bounds.settings import SuggestedSettings, suggest_settings
from ..controllers.base import Controller
from ..paths.identification import PathEstimate, estimate_path
from ..plant import Plant
from .faults import LARGEST
from .health import Health
from .interfaces import Interface
from .supervisor import Supervisor

WORTH_DB = 1.0  # less noise reduction than this, by any filter, is no control
WARM_UP = 1024  # samples, so that a controller that works between blocks has done so
FATAL, FATAL_S = 3, 600.0  # so many divergences within this time end a run
MOST_PARTS = 2048  # whose energies are kept; then neighbours are joined
NOISE_TAPS = 64  # of the filter that makes the unexplained noise white
DELAY_SHARE = 0.05  # of the largest tap, at which a path has arrived


class NotCausalError(ValueError):
    """Raised by `run` if the anti-noise comes too late to reduce the noise."""


class FaultError(RuntimeError):
    """Raised by `run` if the plant cannot be identified: nothing is heard, or nothing comes out."""


@dataclass
class RunStatus:
    """How a run goes: noise reduction, powers, load and health since the last report, handed to `on_report`.

    Attributes
    ----------
    seconds : float
        Time since the control was switched on.
    reduction_db : ndarray, shape (K,)
        Error power before the control over the error power now, in dB, at each error microphone.
    powers : ndarray, shape (J,)
        Output power of each loudspeaker.
    rated_power : ndarray, shape (J,), or None
        Rated powers of the controller.
    load : float
        Largest share of a block's duration that its processing has taken.
    overruns : int
        Blocks so far whose processing took longer than the block.
    lost : int
        Samples lost so far.
    underflows : int
        Blocks so far that came too late for the output. `health` has the times of those under control.
    health : Health
        Health record.
    """

    seconds: float
    reduction_db: np.ndarray
    powers: np.ndarray
    rated_power: np.ndarray | None
    load: float
    overruns: int
    lost: int
    underflows: int
    health: Health


@dataclass
class RunReport(RunStatus):
    """What a run has done.

    Attributes
    ----------
    seconds, reduction_db, powers, rated_power, load, overruns, lost, underflows, health
        Of the whole run, as in `RunStatus`; reduction and powers over its second half.
    stopped_by : str
        "end" of the time or of the noise, "user", or the fault that ended it.
    round_trip_samples : int or None
        Samples from a control signal to its arrival at the nearest error microphone, buffers included; None if the
        path was not identified.
    secondary : PathEstimate or None
        Identified secondary path.
    possible_db : float
        Noise reduction that the best filter of `n_taps` taps reaches in the silence before the control; NaN if that was
        not checked.
    blocks : int
        Blocks under control.
    controller : Controller
        Controller at the end, which can be saved.
    """

    stopped_by: str
    round_trip_samples: int | None
    secondary: PathEstimate | None = field(repr=False)
    possible_db: float
    blocks: int
    controller: Any = field(repr=False)


@dataclass(frozen=True)
class IdentifiedPlant:
    """What `run` knows of a plant before it makes the controller.

    Attributes
    ----------
    path : PathEstimate
        Secondary path, with the buffers of the interface.
    round_trip_samples : int
        Samples from a control signal to its first arrival at an error microphone.
    references, errors : ndarray, shape (n_samples,), or (I, n_samples) and (K, n_samples)
        Microphone signals of the silence before; with one channel, without a channel axis. Without a reference
        microphone, `references` is (0, n_samples).
    fs : float
        Sample rate in Hz.
    """

    path: PathEstimate
    round_trip_samples: int
    references: np.ndarray = field(repr=False)
    errors: np.ndarray = field(repr=False)
    fs: float

    @property
    def taps(self) -> np.ndarray:
        """Taps of the secondary path, (n_path,) or (K, J, n_path)."""
        return self.path.taps

    @property
    def plant(self) -> Plant:
        """Plant with the identified secondary path."""
        return Plant(self.taps, fs=self.fs)

    @property
    def uncertainty(self) -> np.ndarray:
        """Largest relative error of the path, (257,) from 0 to fs/2, for `secondary_path_uncertainty`."""
        return np.asarray(self.path.uncertainty)

    def suggested(self, n_taps: int | None = None) -> SuggestedSettings:
        """Return `suggest_settings` for the noise heard in the silence, with `n_taps` taps or a length that it finds.

        For one channel only. Without a reference microphone, the settings are those of a feedback controller.
        """
        x = self.references if self.references.size else predictor_reference(self.errors)
        return suggest_settings(x, self.plant, disturbance=self.errors, n_taps=n_taps)


@dataclass
class _Heard:
    """Signals of a stretch without control: references (I, n), errors (K, n), and what was played, (J, n)."""

    x: np.ndarray
    e: np.ndarray
    y: np.ndarray


class _Session:
    """An interface in use: it counts what is lost and how long blocks take."""

    def __init__(self, interface: Interface) -> None:
        self.interface = interface
        self.block_s = interface.block / interface.fs
        self.blocks = self.overruns = self.lost = 0
        self.load = self.load_since_report = 0.0
        self._dry_before = getattr(interface, "dry", 0)
        self._noted = 0  # underflows that the health record has, or that were before it

    @property
    def underflows(self) -> int:
        """Blocks of this run that came too late for the output."""
        return int(getattr(self.interface, "dry", 0) - self._dry_before)

    def play(self, signal: np.ndarray) -> _Heard:
        """Play a signal (J, n), and return what was heard meanwhile; a value that is not finite becomes 0."""
        heard: list[Any] = []
        size = self.interface.block
        padded = np.pad(signal, ((0, 0), (0, -signal.shape[1] % size)))
        for begin in range(0, padded.shape[1], size):
            block = self.interface.read()
            if block is None:
                break
            heard.append(block)
            self.interface.write(padded[:, begin : begin + size])
        if not heard:
            raise FaultError("the interface ended before anything was heard")
        self.lost += sum(block.lost for block in heard)
        self._noted = self.underflows
        x, e = (_finite(np.concatenate([block[i] for block in heard], axis=1)) for i in (0, 1))
        return _Heard(x, e, padded[:, : x.shape[1]])

    @contextmanager
    def without_gaps(self, task: str) -> Iterator[None]:
        """Raise FaultError if samples are lost, or the output runs dry, during a task: its result would be wrong."""
        lost, underflows = self.lost, self.underflows
        yield
        lost, underflows = self.lost - lost, self.underflows - underflows
        if lost or underflows:
            gap = f"{lost} samples were lost" if lost else f"the output ran dry {underflows} time(s)"
            raise FaultError(f"{gap} while {task}, so it would be wrong: use longer blocks, or run again")

    def step(self, supervisor: Supervisor) -> tuple[Any, np.ndarray] | None:
        """Process a block; return it with its control signals, None at the end."""
        block = self.interface.read()
        if block is None:
            return None
        began = time.perf_counter()
        y = np.atleast_2d(supervisor.process(block.references, block.errors, lost=block.lost))
        self.interface.write(y)
        if self.underflows > self._noted:
            supervisor.note("output underflow", (self.underflows - self._noted) * y.shape[1])
            self._noted = self.underflows
        share = (time.perf_counter() - began) / self.block_s
        self.blocks += 1
        self.overruns += share > 1.0
        self.lost += block.lost
        self.load = max(self.load, share)
        self.load_since_report = max(self.load_since_report, share)
        return block, y


def _finite(signals: np.ndarray) -> np.ndarray:
    """Return signals with 0 for each value that is no sound."""
    return np.where(np.abs(signals) <= LARGEST, signals, 0.0)


def _recorded(session: _Session, noises: np.ndarray, rest: int) -> list[_Heard]:
    """Play noises (J, n), one from each loudspeaker in turn, and return what was heard meanwhile.

    After each, `rest` samples of silence let it die away.
    """
    recordings = []
    for j, noise in enumerate(noises):
        signal = np.zeros_like(noises)
        signal[j] = noise
        recordings.append(session.play(signal))
        session.play(np.zeros((len(noises), rest)))
    return recordings


def _round_trip(recordings: list[_Heard], longest: int) -> int:
    """Return the first lag at which a loudspeaker is heard."""
    arrivals = [_arrival(own.y[j], e, longest) for j, own in enumerate(recordings) for e in own.e]
    clear = [arrival for arrival in arrivals if arrival is not None]
    if not clear:
        raise FaultError(
            "no loudspeaker is heard by any error microphone: check cables and channels, or raise excitation"
        )
    return min(clear)


def _arrival(sent: np.ndarray, heard: np.ndarray, longest: int) -> int | None:
    """Return the first lag at which a sent noise is clearly heard, up to `longest`; None if it is not."""
    from scipy.signal import correlate

    n = sent.size - longest
    if n < longest or not np.any(sent):
        return None
    correlation = np.abs(correlate(heard, sent[:n], mode="valid"))[: longest + 1]
    chance = np.linalg.norm(sent[:n]) * np.sqrt(np.mean(heard**2))  # standard deviation if it is not heard
    if not np.max(correlation) > 6.0 * chance:
        return None
    return int(np.argmax(correlation > max(DELAY_SHARE * np.max(correlation), 5.0 * chance)))


def run(
    controller: Controller | Callable[[IdentifiedPlant], Controller],
    interface: Interface,
    *,
    amplitude_limit: PerLoudspeaker,
    seconds: float | None = None,
    listen_s: float = 2.0,
    identify_s: float = 5.0,
    excitation: float | None = None,
    n_path: int | None = None,
    check_causality: bool = True,
    on_report: Callable[[RunStatus], Any] | None = None,
    report_every_s: float = 0.25,
    should_stop: Callable[[], bool] | None = None,
    **supervision: Any,
) -> RunReport:
    """Control noise in real time, from the identification of the plant to the fade-out at the end.

    In order: listen to the noise with silent loudspeakers; play noise and identify the secondary paths, with the
    buffers of the interface; check that a control filter can reduce the noise in time; fade in; control; fade out. A
    `Supervisor` stands between the controller and the interface. The run stops by itself after three divergences within
    ten minutes.

    The interface is started twice: to listen and identify, and to control. In between the path is computed and the
    controller is made, which can take seconds. Meanwhile no blocks are read or written. If the streams stayed open,
    they would overflow and run dry, and the round trip could then differ from the one identified.

    Parameters
    ----------
    controller : Controller or callable
        A function that makes the controller from an `IdentifiedPlant`, which has the `taps` of the secondary path and
        their `uncertainty`. Or a controller made for a known path, which must include the delay of the interface:
        nothing is identified then.
    interface : Interface
        `SoundDevice`, `SimulatedInterface` or your own.
    amplitude_limit : float or array_like, shape (J,)
        Largest magnitude of the control signal, see `Supervisor`.
    seconds : float, optional
        Time under control; by default until the noise ends or `should_stop` says so.
    listen_s : float, default 2
        Time of silence before, against which the noise reduction is measured.
    identify_s : float, default 5
        Time for which noise is played to identify the secondary paths, from each loudspeaker in turn.
    excitation : float, optional
        Standard deviation of that noise; by default a tenth of the smallest `amplitude_limit`.
    n_path : int, optional
        Taps of the identified paths; by default the round trip plus 16 ms.
    check_causality : bool, default True
        Whether to refuse a plant in which no causal filter can reduce the noise that was heard.
    on_report : callable, optional
        Called with `RunStatus` every `report_every_s` seconds.
    report_every_s : float, default 0.25
        Time between two reports in seconds.
    should_stop : callable, optional
        Called once for each block; the run ends when it returns True. Ctrl-C ends it too.
    **supervision
        Settings of the `Supervisor`, for example ``pause_s=1.0``.

    Returns
    -------
    RunReport
        What was measured, and the controller.

    Raises
    ------
    NotCausalError
        The anti-noise comes too late.
    FaultError
        No loudspeaker is heard; samples were lost, or the output ran dry, while the path was identified; the interface
        ends too early.
    TypeError, ValueError
        A setting that is out of range, or numbers of channels that do not fit.

    Examples
    --------
    >>> import numpy as np
    >>> from kfopc_filterpy import Plant, kf_pb
    >>> from kfopc_filterpy.realtime import SimulatedInterface, run
    >>> noise = np.random.default_rng(0).standard_normal(100_000)
    >>> primary = np.zeros(120)
    >>> primary[[80, 90]] = 1.0, 0.4
    >>> interface = SimulatedInterface(noise, Plant([0.0, 0.9, 0.3], primary, fs=16000), block=32)
    >>> def make(identified):
    ...     uncertainty = identified.uncertainty
    ...     return kf_pb(32, identified.plant, rated_power=2.0, secondary_path_uncertainty=uncertainty)
    >>> report = run(make, interface, amplitude_limit=10.0, seconds=2.0, identify_s=2.0)
    >>> report.stopped_by, report.round_trip_samples, bool(report.reduction_db[0] > 10.0)
    ('end', 65, True)
    """
    listen_n = max(round(as_nonnegative(listen_s, "listen_s", unit="s") * interface.fs), interface.block)
    limits = per_loudspeaker(amplitude_limit, interface.n_loudspeakers, "amplitude_limit")
    level = 0.1 * float(np.min(limits)) if excitation is None else as_positive(excitation, "excitation")
    identify_s = as_positive(identify_s, "identify_s", unit="s")
    as_positive(report_every_s, "report_every_s", unit="s")
    if seconds is not None:
        as_positive(seconds, "seconds", unit="s")
    if unknown := set(supervision) - set(signature(Supervisor).parameters):
        raise TypeError(f"run has no setting {', '.join(sorted(unknown))}, and Supervisor has none either")
    session = _Session(interface)
    identified = None
    with _open(interface):
        silence = session.play(np.zeros((interface.n_loudspeakers, listen_n)))
        if not isinstance(controller, Controller):
            identified = _identified(session, silence, level, limits, identify_s, n_path)
    made = controller if isinstance(controller, Controller) else controller(identified)  # type: ignore[arg-type]

    known = {"full_scale": None, "blocks_can_repeat": True}
    settings: dict[str, Any] = {name: getattr(interface, name, value) for name, value in known.items()} | supervision
    supervised: Callable[..., Supervisor] = partial(
        Supervisor, fs=interface.fs, amplitude_limit=amplitude_limit, **settings
    )
    supervisor = supervised(made)
    _require_fit(supervisor, interface)
    possible_db = _possible_db(silence, made, interface.fs) if check_causality else np.nan
    _warm_up(supervised(deepcopy(made), louder_s=None), interface.block)
    supervisor.listen(silence.x, silence.e)
    watch = _Watch(session, supervisor, silence, report_every_s, on_report)
    with _open(interface):
        stopped_by = _control(session, supervisor, watch, seconds, should_stop)
    return watch.report(stopped_by, identified, possible_db)


@contextmanager
def _open(interface: Interface) -> Iterator[None]:
    """Open the streams for a while; what takes long is done in between, so that no block is lost."""
    try:
        interface.start()
        yield
    except BaseException:
        with suppress(Exception):  # the first one counts
            interface.stop()
        raise
    interface.stop()


def _warm_up(supervisor: Supervisor, block: int) -> None:
    """Process blocks with a copy of the controller, so that all that it uses is loaded before the first real one."""
    rng, shapes = np.random.default_rng(0), ((supervisor.n_references, block), (supervisor.n_microphones, block))
    signals = [1e-3 * rng.standard_normal(shape) for shape in shapes]
    supervisor.listen(*signals)
    for _ in range(2 * max(WARM_UP // block, 1)):
        supervisor.process(*signals)


def _control(
    session: _Session,
    supervisor: Supervisor,
    watch: _Watch,
    seconds: float | None,
    should_stop: Callable[[], bool] | None,
) -> str:
    """Control until the end; return what ended it. Whatever that is, the loudspeakers fade out."""
    last = np.inf if seconds is None else seconds * supervisor.fs
    done, stopped_by, divergences = 0, "", supervisor.divergence_times_s
    try:
        while not stopped_by:
            stepped = session.step(supervisor)
            if stepped is None:
                return "end"
            watch.add(*stepped)
            done += session.interface.block
            if done >= last:
                stopped_by = "end"
            elif should_stop is not None and should_stop():
                stopped_by = "user"
            elif len(divergences) == FATAL and divergences[-1] - divergences[0] < FATAL_S:
                stopped_by = f"fault: {FATAL} divergences"
    except KeyboardInterrupt:
        stopped_by = "user"
    except Exception:
        with suppress(Exception):  # the first one counts
            _fade_out(session, supervisor)
        raise
    _fade_out(session, supervisor)
    return stopped_by


def _fade_out(session: _Session, supervisor: Supervisor) -> None:
    """Step until the loudspeakers are silent."""
    supervisor.fade_out()
    while not supervisor.muted and session.step(supervisor) is not None:
        pass


class _Watch:
    """Levels of a run, for its reports."""

    def __init__(
        self,
        session: _Session,
        supervisor: Supervisor,
        silence: _Heard,
        every_s: float,
        on_report: Callable[[RunStatus], Any] | None,
    ) -> None:
        self._session, self._supervisor, self._on_report = session, supervisor, on_report
        self._every = max(round(every_s * supervisor.fs), 1)
        self._before = np.mean(silence.e**2, axis=1)
        self._parts: list[np.ndarray] = []  # each as `_new`
        self._part_samples = supervisor.fs
        self._samples = 0
        n_channels = supervisor.n_microphones + supervisor.n_loudspeakers
        self._nothing = np.zeros(1 + n_channels)  # samples, energies of e and of y
        self._new = self._present = self._nothing  # since the last report, and of the present part

    def add(self, block: Any, y: np.ndarray) -> None:
        """Add a block, and report if it is time."""
        energies = (np.sum(np.square(_finite(signals)), axis=1) for signals in (block.errors, y))
        sums = np.concatenate([[y.shape[1]], *energies])
        self._samples += y.shape[1] + block.lost
        self._new, self._present = self._new + sums, self._present + sums
        if self._present[0] >= self._part_samples:
            self._parts.append(self._present)
            self._present = self._nothing
            if len(self._parts) == MOST_PARTS:
                self._part_samples *= 2
                self._parts = [a + b for a, b in zip(self._parts[::2], self._parts[1::2], strict=True)]
        if self._new[0] >= self._every:
            if self._on_report is not None:
                self._on_report(RunStatus(load=self._session.load_since_report, **self._figures(self._new)))
            self._new, self._session.load_since_report = self._nothing, 0.0

    def _figures(self, sums: np.ndarray) -> dict[str, Any]:
        """Return what both reports state, of the sums over a stretch."""
        e, y = np.split(sums[1:] / max(sums[0], 1), [self._before.size])
        rated = getattr(self._supervisor.controller, "rated_power", None)
        return {
            "seconds": self._samples / self._supervisor.fs,
            "reduction_db": _db(self._before, e),
            "powers": y,
            "rated_power": None if rated is None else np.atleast_1d(rated),
            "overruns": self._session.overruns,
            "lost": self._session.lost,
            "underflows": self._session.underflows,
            "health": self._supervisor.health,
        }

    def report(self, stopped_by: str, identified: IdentifiedPlant | None, possible_db: float) -> RunReport:
        """Return the report of the whole run; its figures are those of the second half."""
        if self._present[0] or not self._parts:
            self._parts.append(self._present)
        return RunReport(
            stopped_by=stopped_by,
            round_trip_samples=None if identified is None else identified.round_trip_samples,
            secondary=None if identified is None else identified.path,
            possible_db=possible_db,
            blocks=self._session.blocks,
            load=self._session.load,
            controller=self._supervisor.controller,
            **self._figures(np.sum(self._parts[len(self._parts) // 2 :], axis=0)),
        )


def _db(above: np.ndarray, below: np.ndarray) -> np.ndarray:
    """Return a ratio of powers in dB; infinite or NaN where one is zero."""
    with np.errstate(divide="ignore", invalid="ignore"):
        decibels: np.ndarray = 10.0 * np.log10(above / below)
    return decibels


def _identified(
    session: _Session,
    silence: _Heard,
    level: float,
    limits: np.ndarray,
    identify_s: float,
    n_path: int | None,
) -> IdentifiedPlant:
    """Play noise from each loudspeaker in turn, and return what this tells about the plant."""
    interface = session.interface
    fs, n = interface.fs, round(identify_s * interface.fs)
    noises = level * np.random.default_rng(0).standard_normal((interface.n_loudspeakers, n))
    with session.without_gaps("the path was identified"):
        limited = np.clip(noises, -limits[:, np.newaxis], limits[:, np.newaxis])
        recordings = _recorded(session, limited, rest=round(0.1 * fs))
    round_trip = _round_trip(recordings, n // 4)
    taps = round_trip + round(0.016 * fs) if n_path is None else as_count(n_path, "n_path")
    if taps <= round_trip:
        raise ValueError(f"n_path must exceed the round trip, {round_trip} samples, got {n_path}")
    left = [-_without_noise(r.y[j : j + 1], r.x, r.e, taps, fs) for j, r in enumerate(recordings)]  # e = d - s * y
    length = min(e.shape[1] for e in left)
    sent = np.array([r.y[j, :length] for j, r in enumerate(recordings)])
    heard, x, e = np.array([e[:, :length] for e in left]), silence.x, silence.e
    if interface.n_loudspeakers == interface.n_microphones == 1 >= interface.n_references:
        sent, heard, x, e = sent[0], heard[0, 0], x[0] if len(x) else x, e[0]
    return IdentifiedPlant(_fitted(sent, heard, taps, fs), round_trip, x, e, fs)


def _fitted(sent: np.ndarray, heard: np.ndarray, n_taps: int, fs: float) -> PathEstimate:
    """Return the path by least squares, with a filter that makes what a first fit has not explained white.

    This is noise that no reference microphone hears. A loud tone, for example, then costs accuracy only at its
    frequency.
    """
    from scipy.linalg import solve_toeplitz
    from scipy.signal import fftconvolve, lfilter

    first = estimate_path(sent, heard, n_taps, fs)
    y = np.atleast_2d(sent)[:, np.newaxis]
    e = heard.reshape(len(y), -1, heard.shape[-1])
    paths = first.taps.reshape(e.shape[1], e.shape[0], n_taps).swapaxes(0, 1)
    left = (e - fftconvolve(y, paths, axes=-1)[..., : e.shape[-1]])[..., n_taps - 1 :]
    powers = np.abs(np.fft.rfft(left, 2 * left.shape[-1])) ** 2
    correlation = np.fft.irfft(powers.mean(axis=(0, 1)))[: NOISE_TAPS + 1]
    if not correlation[0] > 0.0:
        return first
    correlation[0] *= 1.0 + 1e-6  # a pure tone would make the system singular
    whitening = np.append(1.0, -solve_toeplitz(correlation[:-1], correlation[1:]))
    return estimate_path(lfilter(whitening, 1.0, sent), lfilter(whitening, 1.0, heard), n_taps, fs)


def _without_noise(y: np.ndarray, x: np.ndarray, e: np.ndarray, n_taps: int, fs: float) -> np.ndarray:
    """Return the errors without the noise that the references explain while a loudspeaker plays y.

    The noise goes on during an identification. Primary paths are fitted together with the secondary paths, so that
    feedback from the loudspeaker to the references does no harm.
    """
    x = x[np.any(x[:, n_taps - 1 :], axis=1)]
    if not len(x):
        return e
    primary = estimate_path(np.concatenate((y, x)), e, n_taps, fs).taps[:, 1:]
    explained = [
        sum(np.convolve(signal, path)[: e.shape[1]] for signal, path in zip(x, paths, strict=True)) for paths in primary
    ]
    return e - np.array(explained)


def _require_fit(supervisor: Supervisor, interface: Interface) -> None:
    for name in ("n_references", "n_microphones", "n_loudspeakers"):
        own, theirs = getattr(supervisor, name), getattr(interface, name)
        if own != theirs:
            raise ValueError(f"the controller has {name} = {own}, but the interface has {theirs}")


def _possible_db(silence: _Heard, controller: Any, fs: float) -> float:
    """Return the noise reduction of the best filter; raise `NotCausalError` if only a faster plant would allow any."""
    path, n_taps = getattr(controller, "secondary", None), getattr(controller, "n_taps", None)
    x, d = silence.x, silence.e
    if getattr(controller, "internal_model", False):
        x = np.concatenate((x, predictor_reference(d)))
    if path is None or n_taps is None or not np.any(d) or not np.any(x):
        return np.nan
    if x.shape[1] < 4 * (n_taps + np.shape(path)[-1]):
        return np.nan
    possible = _best_db(x, d, path, n_taps, fs)
    if possible >= WORTH_DB:
        return possible
    taps = np.abs(np.reshape(path, (-1, np.shape(path)[-1])))
    delay = int(np.argmax(np.any(taps > DELAY_SHARE * np.max(taps), axis=0)))  # until the first path has arrived
    sooner = _best_db(x, d, path[..., delay:], n_taps + delay, fs)
    if sooner < possible + WORTH_DB:
        return possible
    raise NotCausalError(
        f"the anti-noise comes too late: it takes {delay} samples ({1e3 * delay / fs:.1f} ms) to reach the error "
        f"microphone, and no filter of {n_taps} taps reduces the noise by more than {possible:.1f} dB (without this delay "
        f"{sooner:.1f} dB). Use shorter blocks, or place a reference microphone nearer to the noise: each millisecond "
        "corresponds to 34 cm. To run anyway, set check_causality=False"
    )


def _best_db(x: np.ndarray, d: np.ndarray, path: Any, n_taps: int, fs: float) -> float:
    """Return the noise reduction of the best filter of some taps, whatever its power."""
    record = record_of_any(x, d, Plant(path, fs=fs), n_taps)
    return record.solution(record.correlations().weights()).noise_reduction_db
