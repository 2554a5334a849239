"""The page of `explore`: sliders, figures that follow, and sounds, served to browsers on this machine by Bokeh."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from html import escape
from typing import Any

import numpy as np

from kfopc_filterpy import SimulationResult
from kfopc_filterpy._validate import as_count, how_to_install
from kfopc_filterpy.metrics import power_spectrum_db, short_time_power
from kfopc_filterpy.plot.style import decibels

from .exploring import ALGORITHMS, AcousticSetup, ExploreResult, ExploreSettings, explore, explore_setups
from .page import data_uri, flac
from .registry import REGISTRY
from .study_report import loudness

ADDRESS = "127.0.0.1"
PORT = 5006
LOWEST_HZ = 50.0
WAVE_S = 0.03  # of the control signal that is drawn
SEGMENT_S = 0.064  # of the spectra
POWER_WINDOW_S, POWER_EVERY_S = 0.05, 0.01
SOUNDS = ("disturbance", "error")
BELOW_PEAK_DB = 70.0  # that a spectrum shows
QUIETEST_DB = -60.0  # re rated power that is drawn
WIDTH, HEIGHT, SIDE = 470, 285, 290
BLUE, GREEN, ORANGE, GREY = "#0072B2", "#009E73", "#D55E00", "#777777"
RELATIVE, ABSOLUTE = 0, 1
# The curve's key, its legend, colour and dash.
_HEARD = [("disturbance", "without control", GREY, "solid"), ("error", "with control", BLUE, "solid")]
_PLAYED = [("asked", "control signal", BLUE, "solid"), ("delivered", "after the amplifier", GREEN, "dashed")]
_PEAKS = [(key, "peak of a sine at rated power", ORANGE, "dotdash") for key in ("upper", "lower")]
CURVES = {  # of each plot
    "spectrum": _HEARD,
    "wave": [*_PLAYED, *_PEAKS],
    "power": [*_PLAYED, ("rating", "rated power", ORANGE, "dotdash")],
    "level": _HEARD,
}


def serve_explore(
    setups: Sequence[AcousticSetup] | None = None, *, port: int = PORT, announce: Callable[[str], Any] = print
) -> None:
    """Serve the page to browsers on this machine until it is interrupted with Ctrl+C.

    The server listens on 127.0.0.1 only, and the page loads nothing from elsewhere. It needs the extra `explore`.

    Parameters
    ----------
    setups : sequence of AcousticSetup, optional
        Setups to choose from, see `AcousticSetup`; by default those of `explore_setups`.
    port : int, default 5006
        Port; 0 for a free one.
    announce : callable, default print
        Called with a line that names the page's address when the server is ready.

    Raises
    ------
    ModuleNotFoundError
        If Bokeh or threadpoolctl is not installed.
    OSError
        If the port is in use or not allowed.
    ValueError, TypeError
        No setups, or a port that is no number from 0 to 65535.

    Examples
    --------
    >>> from kfopc_filterpy.bench import serve_explore
    >>> serve_explore(port=70000)
    Traceback (most recent call last):
    ...
    ValueError: port must be at most 65535, got 70000
    """
    port = as_count(port, "port", minimum=0)
    if port > 65535:
        raise ValueError(f"port must be at most 65535, got {port}")
    try:
        from bokeh.application import Application
        from bokeh.application.handlers import FunctionHandler
        from bokeh.server.server import Server
        from threadpoolctl import threadpool_limits
    except ImportError as error:
        raise ModuleNotFoundError(f"the page needs Bokeh and threadpoolctl: {how_to_install('explore')}") from error
    choices = list(explore_setups() if setups is None else setups)
    if not choices:
        raise ValueError("setups must not be empty: leave it out for those that need no files")
    port = _free_port(port)
    pool = ThreadPoolExecutor(max_workers=1)  # the server goes on answering while a run computes
    application = Application(FunctionHandler(lambda document: _Page(document, choices, pool).open()))
    # The page's own address is the only origin that may open its socket.
    origins = [f"{ADDRESS}:{port}", f"localhost:{port}"]
    server = Server({"/": application}, address=ADDRESS, port=port, allow_websocket_origin=origins)
    server.start()
    announce(f"open http://{ADDRESS}:{port}/ in a browser; Ctrl+C ends it")
    try:
        # Systems of 128 unknowns gain nothing from more threads, which wait for each other if the cores have other work.
        with threadpool_limits(1):
            server.io_loop.start()
    except KeyboardInterrupt:
        announce("ended")
    finally:
        server.stop()
        pool.shutdown(cancel_futures=True)


def _free_port(port: int) -> int:
    """Return a port that is free: `port`, or any if it is 0."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((ADDRESS, port))
        except OSError as error:
            reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise OSError(f"port {port} of {ADDRESS} {reason}: choose another, or 0 for a free one") from error
        return probe.getsockname()[1]


class _Page:
    """One browser tab: its controls, its figures, and the run that is under way."""

    def __init__(self, document: Any, setups: list[AcousticSetup], pool: ThreadPoolExecutor) -> None:
        self.document, self.setups, self.pool = document, setups, pool
        self.setup = setups[0]
        self.controls = _controls(setups)
        self.sources, self.plots = _figures()
        self.texts = _texts()
        self._is_running = self._is_filling = self._is_asked = self._is_new_setup = self._is_closed = False

    def open(self) -> None:
        """Lay the page out, connect the controls, and start the first run."""
        from bokeh.layouts import column, gridplot, row

        self.document.on_session_destroyed(self._close)
        left = column(*self.controls.values(), width=SIDE)
        rows = [[self.plots["spectrum"], self.plots["wave"]], [self.plots["level"], self.plots["power"]]]
        right = column(self.texts["summary"], gridplot(rows, toolbar_options={"logo": None}), self.texts["sounds"])
        self.document.add_root(row(left, column(self.texts["status"], right, margin=(0, 0, 0, 20))))
        self.document.title = "kfopc explore"
        for name, control in self.controls.items():
            changing = {"rating_kind": "active", "clips": "active"}.get(name, "value")
            control.on_change(changing, partial(self._changed, name))
        self._take_setup()
        self._run()

    def _changed(self, name: str, attribute: str, old: Any, new: Any) -> None:
        """Run again, now or after the run that is under way: a slider that is dragged sends more values than can be run.

        A control that is disabled does not count for the run. The page itself moves it, and Bokeh tells of that late.
        """
        if self._is_filling or self.controls[name].disabled:
            return
        if name == "setup":
            self.setup = self.setups[int(new)]
            self._take_setup()
        self._enable()
        if self._is_running:
            self._is_asked = True
        else:
            self._run()

    def _take_setup(self) -> None:
        """Set what depends on the setup: the level, and the range of the band."""
        self._is_filling, self._is_new_setup = True, True
        highest = self.setup.fs / 2
        band, level = self.controls["band"], self.controls["level_db"]
        band.end = highest
        band.value = (200.0, min(2000.0, highest)) if self.setup.noise is None else (LOWEST_HZ, highest)
        middle = round(self.setup.level_db)
        level.update(start=middle - 30, end=middle + 30, value=middle)
        self.controls["rating_kind"].active = RELATIVE
        self._is_filling = False
        self._enable()

    def _enable(self) -> None:
        """Let only the controls be moved that the run depends on."""
        algorithm, kind = self.controls["algorithm"].value, self.controls["rating_kind"].active
        symbol = REGISTRY[algorithm].symbol
        disabled = {
            "relative_rating": kind != RELATIVE,
            "absolute_rating": kind != ABSOLUTE,
            "path_tolerance_samples": algorithm != "KF-PB",
            "state_noise": symbol != "r",
            "step_size": symbol != "mu",
        }
        for name, value in disabled.items():
            self.controls[name].update(disabled=value, styles={"opacity": "0.4" if value else "1"})

    def _settings(self) -> ExploreSettings:
        value: dict[str, Any] = {name: getattr(control, "value", None) for name, control in self.controls.items()}
        is_relative = self.controls["rating_kind"].active == RELATIVE
        same = ("algorithm", "level_db", "band", "path_error_samples", "path_tolerance_samples")
        return ExploreSettings(
            **{name: value[name] for name in same},
            rating_db=value["relative_rating" if is_relative else "absolute_rating"],
            rating_is_relative=is_relative,
            state_noise=10.0 ** value["state_noise"],
            step_size=2.0 ** value["step_size"],
            clips=bool(self.controls["clips"].active),
        )

    def _run(self) -> None:
        self._is_running, self._is_asked = True, False
        self.texts["status"].text = "Computing …"
        start = time.perf_counter()
        future = self.pool.submit(explore, self.setup, self._settings())
        future.add_done_callback(partial(self._ended, start))

    def _ended(self, start: float, done: Future[ExploreResult]) -> None:
        if not self._is_closed:  # or else the server has given up the document
            self.document.add_next_tick_callback(partial(self._show, done, start))

    def _close(self, context: Any) -> None:
        self._is_closed = True

    def _show(self, done: Future[ExploreResult], start: float) -> None:
        """Show a run that has ended, all at once; then start the one that was asked for meanwhile."""
        self._is_running = False
        self.document.hold("combine")
        try:
            self._fill(done.result())
            self.texts["status"].text = f"Computed in {time.perf_counter() - start:.2f} s."
        except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
            self.texts["status"].text = f"<b>Not computed:</b> {escape(' '.join(str(error).split()))}"
        finally:
            self.document.unhold()
        if self._is_asked:
            self._run()

    def _fill(self, result: ExploreResult) -> None:
        drawn = curves(result)
        for name, data in drawn.items():
            self.sources[name].data = data
        self._fill_ratings(result)
        levels = np.concatenate([drawn["spectrum"][name] for name in SOUNDS])
        top = np.max(levels, where=np.isfinite(levels), initial=-np.inf)
        self.plots["spectrum"].y_range.update(start=float(top - BELOW_PEAK_DB), end=float(top + 5))
        self.plots["spectrum"].x_range.end = result.run.fs / 2
        asked = drawn["wave"]["asked"]
        most = float(np.max(np.abs(asked), initial=0.0, where=np.isfinite(asked)))
        height = 1.15 * min(max(most, result.amplitude_limit), 4 * result.amplitude_limit)
        self.plots["wave"].y_range.update(start=-height, end=height)
        self.texts["summary"].text = f'<p style="margin:0;font-size:15px">{escape(result.summary)}</p>'
        self.texts["sounds"].text = _players(result.run)

    def _fill_ratings(self, result: ExploreResult) -> None:
        """Let the slider of the other kind of rating show what the rating is in its terms."""
        kind = self.controls["rating_kind"].active
        absolute, relative = self.controls["absolute_rating"], self.controls["relative_rating"]
        rated, full = (float(decibels(power)) for power in (result.rated_power, result.full_power))
        if self._is_new_setup:
            absolute.update(start=round(full) - 40, end=round(full) + 20)
            self._is_new_setup = False
        if kind == RELATIVE:
            absolute.value = float(np.clip(round(rated, 1), absolute.start, absolute.end))
        else:
            relative.value = float(np.clip(round(rated - full, 1), relative.start, relative.end))


def curves(result: ExploreResult) -> dict[str, dict[str, np.ndarray]]:
    """Return the curves of the page's plots: "spectrum", "wave", "power" and "level"."""
    run = result.run
    end = run.n_samples if run.diverged_at_s is None else round(run.diverged_at_s * run.fs)
    last = slice(max(end - round(WAVE_S * run.fs), 0), end)
    limit = np.full(end - last.start, result.amplitude_limit)
    spectra = {name: power_spectrum_db(getattr(run, name), run.fs, segment_s=SEGMENT_S) for name in SOUNDS}
    heard = spectra["error"][0] >= LOWEST_HZ
    shown = slice(round(POWER_WINDOW_S * run.fs) - 1, None, round(POWER_EVERY_S * run.fs))  # from the first full window

    def level(name: str, over: float = 1.0) -> np.ndarray:
        return decibels(short_time_power(getattr(run, name), run.fs, POWER_WINDOW_S)[shown] / over)

    asked, delivered = (level(name, result.rated_power) for name in ("control_signal", "amplifier_output"))
    return {
        "spectrum": {"x": spectra["error"][0][heard], **{name: own[heard] for name, (_, own) in spectra.items()}},
        "wave": {
            "x": 1000 * np.arange(last.start, end) / run.fs,
            "asked": run.control_signal[last],
            "delivered": run.amplifier_output[last],
            "upper": limit,
            "lower": -limit,
        },
        "power": {
            "x": run.time_s[shown],
            "asked": np.where(asked > QUIETEST_DB, asked, np.nan),
            "delivered": np.where(delivered > QUIETEST_DB, delivered, np.nan),
            "rating": np.zeros(asked.size),
        },
        "level": {"x": run.time_s[shown], **{name: level(name) for name in SOUNDS}},
    }


def _controls(setups: list[AcousticSetup]) -> dict[str, Any]:
    """Return the controls, from the top of the page to its bottom."""
    from bokeh.models import CheckboxGroup, CustomJSTickFormatter, RadioButtonGroup, RangeSlider, Select, Slider

    controls: dict[str, Any] = {}

    def add(kind: Any, name: str, **options: Any) -> None:
        controls[name] = kind(name=name, width=SIDE, **options)

    def slide(name: str, title: str, start: float, end: float, value: Any, step: float, **more: Any) -> None:
        kind = RangeSlider if np.ndim(value) else Slider
        add(kind, name, title=title, start=start, end=end, value=value, step=step, **more)

    powers_of_ten = CustomJSTickFormatter(code="return Math.pow(10, tick).toExponential(1)")
    powers_of_two = CustomJSTickFormatter(code="return Math.pow(2, tick).toPrecision(2)")
    names = [(str(i), setup.name) for i, setup in enumerate(setups)]
    own = ExploreSettings()
    state_noise, step_size = np.log10(own.state_noise), np.log2(own.step_size)
    add(Select, "setup", title="Paths and noise", options=names, value="0")
    add(Select, "algorithm", title="Algorithm", options=list(ALGORITHMS), value=own.algorithm)
    add(RadioButtonGroup, "rating_kind", labels=["rating follows the noise", "rating is fixed"], active=RELATIVE)
    slide("relative_rating", "Rated power over that of full control (dB)", -30, 10, own.rating_db, 0.5)
    slide("absolute_rating", "Rated power (dB re 1)", -40, 20, 0, 0.5)
    add(CheckboxGroup, "clips", labels=["amplifier clips at its rating"], active=[0])
    slide("level_db", "Noise at the error microphone (dB re 1)", -30, 30, 0, 1)
    slide("band", "Band of the noise (Hz)", LOWEST_HZ, 8000, own.band, 50, format="0")
    slide("path_error_samples", "True path later than the known path (samples)", 0, 4, 0, 0.5)
    slide(
        "path_tolerance_samples", "Path error that KF-PB allows for (samples)", 0, 4, own.path_tolerance_samples, 0.25
    )
    slide("state_noise", "State noise r E[x'²]/q", -9, -3, state_noise, 0.5, format=powers_of_ten)
    slide("step_size", "Step size µ L E[x'²]", -14, 0, step_size, 1, format=powers_of_two)
    return controls


def _figures() -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the sources of the plots, and the plots."""
    from bokeh.models import ColumnDataSource, FixedTicker, Range1d
    from bokeh.plotting import figure

    titles = {
        "spectrum": ("Spectrum at the error microphone", "Frequency (Hz)", "Power density (dB re 1/Hz)"),
        "wave": ("Control signal, the last 30 ms", "Time (ms)", "Amplitude"),
        "level": ("Level at the error microphone", "Time (s)", "Power (dB re 1)"),
        "power": ("Output power against the rating", "Time (s)", "Power (dB re rated power)"),
    }
    sources, plots = {}, {}
    for name, (title, x_label, y_label) in titles.items():
        own = CURVES[name]
        source = ColumnDataSource({key: [] for key in ("x", *(curve for curve, *_ in own))}, name=f"{name} curves")
        plot = figure(
            name=f"{name} plot",
            title=title,
            x_axis_label=x_label,
            y_axis_label=y_label,
            x_axis_type="log" if name == "spectrum" else "auto",
            width=WIDTH,
            height=HEIGHT,
            tools="pan,box_zoom,wheel_zoom,reset,save",
            active_scroll=None,
        )
        for curve, legend, colour, dash in own:
            plot.line("x", curve, source=source, legend_label=legend, color=colour, line_dash=dash, line_width=1.5)
        legend = plot.legend[0]
        legend.update(orientation="horizontal", border_line_color=None, label_text_font_size="9pt")
        legend.update(padding=0, margin=0, spacing=12, glyph_width=20)
        plot.add_layout(legend, "above")  # it would cover curves inside
        sources[name], plots[name] = source, plot
    plots["spectrum"].x_range = Range1d(LOWEST_HZ, 8000)
    plots["spectrum"].xaxis.ticker = FixedTicker(ticks=[50, 100, 200, 500, 1000, 2000, 5000])
    for name in ("spectrum", "wave"):
        plots[name].y_range = Range1d(-1, 1)
    plots["level"].x_range = plots["power"].x_range
    return sources, plots


def _texts() -> dict[str, Any]:
    from bokeh.models import Div

    options: dict[str, dict[str, Any]] = {"status": {"styles": {"color": "#555555"}}, "summary": {"min_height": 66}}
    return {name: Div(name=name, text="", width=2 * WIDTH, **options.get(name, {})) for name in (*options, "sounds")}


def _players(run: SimulationResult) -> str:
    """Return the players of the noise without and with control, which have one scale."""
    signals, full_scale = loudness([run.disturbance, run.error])
    players = []
    for name, signal in zip(("Without control", "With control"), signals, strict=True):
        source = data_uri(flac(signal / full_scale, run.fs), "audio/flac")
        players.append(
            f'<figure style="margin:0;display:inline-block;width:445px"><figcaption>{name}</figcaption>'
            f'<audio controls style="width:425px" src="{source}"></audio></figure>'
        )
    is_cut = np.nanmax(np.abs(run.error)) > full_scale
    cut = " What exceeds four times the peak of the noise is cut off." if is_cut else ""
    note = '<p style="margin:2px 0;color:#555555">Both have one scale. The control is switched on as they begin.'
    return "".join(players) + note + cut + "</p>"
