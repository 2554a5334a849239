"""The health record of a run: what went wrong, when, how often."""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass

MOST_KINDS, OTHER = 100, "other"  # of events, which an exception's words can make many; what the rest are
LONGEST_TEXT = 200
JOINED_S = 0.1  # events of a kind that are closer to each other are one


@dataclass
class Fault:
    """An event of a health record.

    Attributes
    ----------
    time_s : float
        Time of its first sample in seconds since the start.
    what : str
        What happened, see `Health`.
    channel : str
        For example "reference 0", "error 2" or "loudspeaker 1"; empty if it concerns no channel.
    n_samples : int
        Number of samples concerned.
    until_s : float
        Time after its last sample.
    """

    time_s: float
    what: str
    channel: str = ""
    n_samples: int = 1
    until_s: float = 0.0


class Health:
    """What a supervisor has noticed.

    It stays small however long the run is, and whatever an exception says: the newest events are kept, and the counts
    go on. Texts are cut to 200 characters, and after a hundred kinds of events a new kind counts as "other".

    Attributes
    ----------
    events : deque of Fault
        The newest 1000 events, in order of their time. Events of one kind in one channel that follow each other within
        0.1 s are one.
    samples : collections.Counter
        Number of samples concerned, by what happened.
    counts : collections.Counter
        Number of events, by what happened: "not finite", "clipped", "stuck", "offset", "repeated" and "lost" samples of
        the microphones; what was "refused" in silence; "limited" control signals; "output underflow", a block that came
        too late for the output; "diverged: ..." and then "muted"; "louder than before control", which ends in
        "diverged: louder than without control" or "the noise itself is louder"; "silent: no usable input" and "running
        again".

    Examples
    --------
    >>> from kfopc_filterpy.realtime import Health
    >>> health = Health()
    >>> health.note("clipped", "error 0", time_s=1.0, n_samples=3, until_s=1.01)
    >>> health.note("clipped", "error 0", time_s=1.05, n_samples=2, until_s=1.06)  # the same event goes on
    >>> health.counts["clipped"], health.samples["clipped"], len(health.events)
    (1, 5, 1)
    >>> health
    <Health: 1 clipped>
    """

    def __init__(self) -> None:
        self.events: deque[Fault] = deque(maxlen=1000)
        self.samples: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self._latest: dict[tuple[str, str], Fault] = {}

    def note(
        self, what: str, channel: str = "", *, time_s: float, n_samples: int = 1, until_s: float | None = None
    ) -> None:
        """Record an event, or extend the last one of its kind.

        Parameters
        ----------
        what, channel : str
            What happened, and where; see `Fault`.
        time_s, until_s : float
            Time of its first sample and after its last one, in seconds.
        n_samples : int, default 1
            Number of samples concerned.
        """
        until_s = time_s if until_s is None else until_s
        what, channel = what[:LONGEST_TEXT], channel[:LONGEST_TEXT]
        if what not in self.counts and len(self.counts) >= MOST_KINDS:
            what = OTHER
        if len(self._latest) >= MOST_KINDS:  # only forgets which events could go on
            self._latest.clear()
        self.samples[what] += n_samples
        latest = self._latest.get((what, channel))
        if latest is not None and time_s - latest.until_s <= JOINED_S and until_s > time_s:
            latest.n_samples += n_samples
            latest.until_s = until_s
            return
        self.counts[what] += 1
        self._latest[what, channel] = Fault(time_s, what, channel, n_samples, until_s)
        self.events.append(self._latest[what, channel])

    def __repr__(self) -> str:
        return f"<Health: {', '.join(f'{n} {what}' for what, n in self.counts.items()) or 'nothing noticed'}>"
