"""Why a recording explains another badly: clocks that drift, samples that are missing, or files that are swapped."""

from __future__ import annotations

import numpy as np

_SEGMENT_S, _LEAST_SEGMENTS, _MOST_SEGMENTS = 1.0, 8, 64
_LEAST_DELAY, _LEAST_JUMP = 0.5, 8  # samples by which the delay must change over a record, or at once
_LARGEST_DRIFT = 1e-3  # of clocks; quartzes differ by less, so more is a jump between the halves
_LEAST_POWER = 0.01  # of the loudest segment: in a pause, nothing tells the delay
_LEAST_GAIN = 0.8  # of the power left unexplained, once the delay is put right: what does less is not the cause
_LEAST_PEAK = 100  # times the mean square of a response; of a million samples of noise, the highest has 28 times
_LEAST_LEAD = 0.5  # of a response's energy that comes before time 0: the files are swapped
_SPECTRUM = 4096  # samples of a spectrum's segments at most
_FLOOR = 1e-3  # of the mean power, added to a spectrum that is divided by
_FRAMES, _NEAR, _ONCE = 64, 2, 0.8  # of a record; frames near the loudest, which have this share if played once
_LOST = "a block was lost, so record both again in one stream, or cut both there."


def timing_fault(sent: np.ndarray, heard: np.ndarray, fs: float, names: tuple[str, str]) -> str | None:
    """Return what is wrong with the timing of two recordings (n_samples,), as a sentence with its number; None if nothing is.

    The response from one to the other is estimated in segments of about a second. Its delay rises evenly if the clocks
    differ, and jumps where samples are missing. A cause is named only if putting it right leaves clearly less unexplained.
    The halves of the record are compared, too: of sweeps, each second has another band. See `plays_once` for one sweep.
    """
    from scipy.ndimage import map_coordinates

    n = min(sent.size, heard.size)
    sent, heard = sent[:n] - np.mean(sent), heard[:n] - np.mean(heard)
    left = _unexplained(sent, heard)
    segments = int(np.clip(n / (_SEGMENT_S * fs), _LEAST_SEGMENTS, _MOST_SEGMENTS))
    for count in (segments,) if plays_once(sent) else (segments, 2):
        cause, places = _cause(sent, heard, count, fs, names[1])
        if cause and _unexplained(sent, map_coordinates(heard, [places], order=3)) < _LEAST_GAIN * left:
            return cause
    lead = _lead(sent, heard) if left < _LEAST_LEAD else 0
    early = f"{names[1]} comes {1e3 * lead / fs:.3g} ms before {names[0]}"
    return f"{early}: are the files swapped, or was a block lost?" if lead else None


def plays_once(sent: np.ndarray) -> bool:
    """Return whether each frequency is played once, and not all of them at the same time, as in a single sweep.

    Then clocks that differ and lost samples cannot be told from a path that delays some frequencies more than others.
    """
    if sent.size < 2 * _FRAMES:
        return False
    frames = sent[: sent.size // _FRAMES * _FRAMES].reshape(_FRAMES, -1)
    power = np.abs(np.fft.rfft(np.hamming(frames.shape[1]) * frames)) ** 2
    loudest = np.argmax(power, axis=0)
    near = np.abs(np.arange(_FRAMES)[:, np.newaxis] - loudest) <= _NEAR
    spread = np.sqrt(np.cov(loudest, aweights=np.sum(power, axis=0)))
    return bool(np.sum(power[near]) > _ONCE * np.sum(power) and spread > 2 * _NEAR)


def _cause(sent: np.ndarray, heard: np.ndarray, count: int, fs: float, name: str) -> tuple[str, np.ndarray]:
    """Return what the delays of segments show, as a sentence, and where each sample should be; nothing if they are equal."""
    every, size = np.arange(sent.size), sent.size // count
    sent, heard = sent[: count * size], heard[: count * size]
    delays = _delays(sent.reshape(count, size), heard.reshape(count, size))
    times = (np.arange(count) + 0.5) * size
    slope, start = np.polyfit(times, delays, 1)
    splits = [np.concatenate([part - part.mean() for part in np.split(delays, [at])]) for at in range(1, count)]
    at = 1 + int(np.argmin([np.sum(left**2) for left in splits]))
    jump = round(float(np.median(delays[at:]) - np.median(delays[:at])))
    if count == 2:
        has_jumped, since = abs(slope) > _LARGEST_DRIFT, "in its second half"
    else:
        steadier = np.sum(splits[at - 1] ** 2) < np.sum((delays - start - slope * times) ** 2)
        has_jumped, since = abs(jump) >= _LEAST_JUMP and steadier, f"from about {at * size / fs:.2g} s on"
    if has_jumped:
        later = "later" if jump > 0 else "earlier"
        cause = f"{since}, {name} is {abs(jump)} samples {later} than before: {_LOST}"
        return cause, every + np.where(every < at * size, 0, jump)
    if abs(slope) * every.size >= _LEAST_DELAY:
        cause = (
            f"the delay of {name} drifts by {slope * every.size:+.1f} samples, so the clocks differ by {1e6 * slope:+.1f} ppm: "
            "record both with one interface, or with a common clock."
        )
        return cause, every * (1 + slope)
    return "", every


def _unexplained(sent: np.ndarray, heard: np.ndarray) -> float:
    """Return the share of a recording's power that its coherence with another leaves unexplained."""
    from scipy.signal import coherence, welch

    segment = min(_SPECTRUM, sent.size // 16)
    power = welch(heard, nperseg=segment)[1]
    return float(np.sum((1 - coherence(sent, heard, nperseg=segment)[1]) * power) / np.sum(power))


def _responses(sent: np.ndarray, heard: np.ndarray) -> np.ndarray:
    """Return the impulse responses between segments (n_segments, size), from time 0 to the middle, then from before time 0."""
    window = np.hanning(sent.shape[-1])
    x, d = (np.fft.rfft(window * one, 2 * one.shape[-1]) for one in (sent, heard))
    power = np.abs(x) ** 2
    return np.fft.irfft(np.conj(x) * d / (power + _FLOOR * np.mean(power)))


def _delays(sent: np.ndarray, heard: np.ndarray) -> np.ndarray:
    """Return the delay of each segment, in samples from that of the loudest, by comparing their responses.

    A pause has the delay of the segments beside it.
    """
    spectra = np.fft.rfft(_responses(sent, heard))
    similar = np.fft.irfft(np.conj(spectra[np.argmax(np.sum(heard**2, axis=1))]) * spectra)
    peaks = np.argmax(similar, axis=1)
    rows = np.arange(len(peaks))
    before, at, after = (similar[rows, (peaks + step) % similar.shape[1]] for step in (-1, 0, 1))
    curvature = before - 2 * at + after
    fine = np.divide(before - after, 2 * curvature, out=np.zeros_like(at), where=curvature < 0)
    whole = (peaks + similar.shape[1] // 2) % similar.shape[1] - similar.shape[1] // 2
    powers = np.sum(sent**2, axis=1)
    loud = np.flatnonzero(powers > _LEAST_POWER * powers.max())
    return np.interp(np.arange(len(powers)), loud, (whole + fine)[loud])


def _lead(sent: np.ndarray, heard: np.ndarray) -> int:
    """Return by how many samples a recording comes before the one that should cause it; 0 if it does not."""
    segment = min(_SPECTRUM, sent.size // 16)
    n = sent.size // segment * segment
    x, d = (np.fft.rfft(np.hanning(segment) * one[:n].reshape(-1, segment), 2 * segment) for one in (sent, heard))
    power = np.mean(np.abs(x) ** 2, axis=0)
    response = np.fft.irfft(np.mean(np.conj(x) * d, axis=0) / (power + _FLOOR * np.mean(power)))
    early = response[segment:] ** 2
    lead = segment - int(np.argmax(early))
    return lead if np.sum(early) > _LEAST_LEAD * np.sum(response**2) and lead > 1 else 0


def delay_of(sent: np.ndarray, heard: np.ndarray) -> int:
    """Return the delay in samples at which a recording is most like the one that should cause it; 0 if there is none."""
    response = _responses(sent[np.newaxis], heard[np.newaxis])[0] ** 2
    delay = int(np.argmax(response[: sent.size]))
    return delay if response[delay] > _LEAST_PEAK * np.mean(response) else 0
