"""The needle's sensor: the force along it, and an OCT A-scan ahead of its tip.

An A-scan is 1,025 bins of 5 µm, counted from the tip, in whole counts of an 8-bit digitiser.
Outside the tissue nothing is brighter than its surface, a peak at the tip-to-tissue distance; the
light scattered behind it decays exponentially. Inside, the scatter begins at the tip. The target
layer is a second, weaker peak; where speckle is bright it saturates, as the surface does. Beyond
the last bin nothing is seen.

Scattered light carries speckle, a grain that is fixed to the tissue and drawn for each episode
(Schmitt, Xiang, Yung, "Speckle in optical coherence tomography", J. Biomed. Opt. 4(1), 1999). The
gain drifts, the digitiser saturates, scans come late, and some are lost: then the last scan is
repeated.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from pipeline.data.insertion import ALINE_BINS

READING_HZ: Final = 650
READINGS_PER_SCAN: Final = 5
"""The spectrometer is slower than the reader: each A-scan is read five times (130 Hz)."""
BIN_MM: Final = 0.005
A_SCAN_BINS: Final = ALINE_BINS
SCANS_LATE: Final = 2
"""The number of scans that are still in the spectrometer: a delay of 15 ms."""

_LOST_SCANS = 0.02
_BACKGROUND, _NOISE = 20.0, 0.35
_SPECKLE_CONTRAST, _SPECKLE_BINS = 0.3, 4
_GAIN_DRIFT, _GAIN_DRIFT_HZ = 0.05, 0.11
_FORCE_NOISE_N, _FORCE_DRIFT_N, _FORCE_DRIFT_HZ = 0.01, 0.02, 0.07
_ORIGIN: Final = 2 * A_SCAN_BINS
_OFFSETS: Final = np.arange(-_ORIGIN, 2 * A_SCAN_BINS + 1)
"""Bins from a surface or a layer."""


@dataclass(frozen=True)
class NeedleContact:
    """Where the needle is relative to the tissue, one row for each reading.

    `distance_mm` is from the tip to the surface, 0 in contact; `layer_mm` is from the tip to the
    target layer; `inside` is whether the surface is punctured; `force_n` is along the needle.
    """

    distance_mm: NDArray[np.float64]
    layer_mm: NDArray[np.float64]
    inside: NDArray[np.bool_]
    force_n: NDArray[np.float64]


class NeedleSensor:
    """The sensor of one episode: its gain, its tissue's speckle, and the delayed scans."""

    def __init__(self, gain: float, seed: int) -> None:
        rng = np.random.default_rng([seed, 103])
        self._gain, self._phase = gain, rng.uniform(0, 2 * np.pi)
        self._speckle = _speckle(rng)
        self._under_way: NDArray[np.float32] | None = None

    def read(
        self, contact: NeedleContact, start_s: float, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """The next readings (row, 1026) at 650 Hz: force in N, then A-scan.

        The number of rows is a multiple of `READINGS_PER_SCAN`. The force drifts slowly.
        """
        fresh = slice(None, None, READINGS_PER_SCAN)
        seen = NeedleContact(*(values[fresh] for values in vars(contact).values()))
        time = start_s + np.arange(len(contact.force_n)) / READING_HZ
        taken = self.a_scans(seen, time[fresh], rng)
        if self._under_way is None:  # before the episode the needle hung at its first pose
            self._under_way = np.repeat(taken[:1], SCANS_LATE + 1, axis=0)
        # The first of the delayed scans was read last; it is repeated if the next one is lost.
        scans = np.concatenate([self._under_way, taken])
        arrived = np.where(rng.random(len(taken)) < _LOST_SCANS, 0, np.arange(1, len(taken) + 1))
        shown = scans[np.maximum.accumulate(arrived)]
        self._under_way = np.concatenate([shown[-1:], scans[-SCANS_LATE:]])
        drift = _FORCE_DRIFT_N * np.sin(2 * np.pi * _FORCE_DRIFT_HZ * time)
        force = contact.force_n + drift + _FORCE_NOISE_N * rng.standard_normal(len(time))
        readings = np.empty((len(time), 1 + A_SCAN_BINS), np.float32)
        # A force amplifier resolves 1 mN; the quantised values also compress.
        readings[:, 0] = np.rint(force * 1000) / 1000
        readings[:, 1:] = np.repeat(shown, READINGS_PER_SCAN, axis=0)
        return readings

    def a_scans(
        self, contact: NeedleContact, time_s: NDArray[np.float64], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """A-scans (row, 1025) in counts, a whole number in 0..255, with digitiser noise."""
        surface = _ORIGIN - np.where(contact.inside, 0, distance_bin(contact.distance_mm))
        layer = _ORIGIN - distance_bin(contact.layer_mm)
        outside = ~contact.inside[:, None]
        scattered = (_SCATTER[surface] + _LAYER[layer]) * self._speckle[layer]
        gain = 1 + _GAIN_DRIFT * np.sin(2 * np.pi * _GAIN_DRIFT_HZ * time_s + self._phase)
        signal = (
            np.float32(self._gain)
            * gain.astype(np.float32)[:, None]
            * (scattered + outside * _SURFACE[surface])
        )
        noise = rng.standard_normal(signal.shape, np.float32) * np.float32(_NOISE)
        # Rounded separately, rows of a still needle differ in few bins and compress.
        return np.clip(np.rint(_BACKGROUND + signal) + np.rint(noise), 0, 255, dtype=np.float32)


def distance_bin(distance_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """The bin nearest to a distance; at most a scan's length beyond the last bin."""
    return np.clip(np.rint(distance_mm / BIN_MM), -A_SCAN_BINS, _ORIGIN).astype(np.int64)


def _scans_of(table: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
    """(start, 1025) every part of a table that a scan may show, without a copy."""
    return sliding_window_view(table.astype(np.float32), A_SCAN_BINS)


def _speckle(rng: np.random.Generator) -> NDArray[np.float32]:
    """A grain of mean 1 along the tissue, as `_scans_of`: amplitudes of summed random phasors."""
    size = (2, 2 * _ORIGIN + _SPECKLE_BINS)
    phasors = np.cumsum(rng.standard_normal(size), axis=1)
    amplitude = np.hypot(*(phasors[:, _SPECKLE_BINS:] - phasors[:, :-_SPECKLE_BINS]))
    grain = 1 + _SPECKLE_CONTRAST * (amplitude / amplitude.mean() - 1) / 0.523
    return _scans_of(np.maximum(grain, 0))


def _peak(height: float, width_bins: float) -> NDArray[np.float32]:
    return _scans_of(height * np.exp(-0.5 * (_OFFSETS / width_bins) ** 2))


def _scatter(height: float, decay_bins: float) -> NDArray[np.float32]:
    """Scattered light behind the surface."""
    decay = height * np.exp(-np.maximum(_OFFSETS, 0) / decay_bins)
    return _scans_of(np.where(_OFFSETS >= 0, decay, 0))


_SCATTER: Final = _scatter(60.0, 180.0)
_SURFACE: Final = _peak(165.0, 14.0)
_LAYER: Final = _peak(90.0, 18.0)
