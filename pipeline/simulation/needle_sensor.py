"""What the needle measures: the force along it, and an OCT A-scan that looks ahead of its tip.

An A-scan is 1,025 bins of 5 µm, counted from the tip, in whole counts of an 8-bit digitiser.
Outside the tissue its surface is the strongest peak, at the tip-to-tissue distance, with light
scattered behind it that decays exponentially; inside, the scatter begins at the tip. The target
layer is a second, weaker peak. Beyond the last bin nothing is seen.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from pipeline.data.insertion import ALINE_BINS

READING_HZ: Final = 650
READINGS_PER_SCAN: Final = 5
"""The spectrometer is slower than the reader: each A-scan is read five times (130 Hz)."""
BIN_MM: Final = 0.005
A_SCAN_BINS: Final = ALINE_BINS

_BACKGROUND, _NOISE = 20.0, 0.35
_FORCE_NOISE_N, _FORCE_DRIFT_N, _FORCE_DRIFT_HZ = 0.01, 0.02, 0.07


@dataclass(frozen=True)
class NeedleContact:
    """How needle and tissue stand to each other, a row a reading.

    `distance_mm` from the tip to the surface, 0 in contact; `layer_mm` from the tip to the target
    layer; `inside` whether the surface is punctured; `force_n` along the needle.
    """

    distance_mm: NDArray[np.float64]
    layer_mm: NDArray[np.float64]
    inside: NDArray[np.bool_]
    force_n: NDArray[np.float64]


def distance_bin(distance_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """The bin nearest to a distance, far distances held a scan's length beyond the last bin."""
    return np.clip(np.rint(distance_mm / BIN_MM), -A_SCAN_BINS, _ORIGIN).astype(np.int64)


def a_scans(contact: NeedleContact, gain: float, rng: np.random.Generator) -> NDArray[np.float32]:
    """A-scans (row, 1025) in counts, a whole number in 0..255, with digitiser noise."""
    bins = np.arange(A_SCAN_BINS)
    surface = np.where(contact.inside, 0, distance_bin(contact.distance_mm))
    behind_surface = bins - surface[:, None] + _ORIGIN
    behind_layer = bins - distance_bin(contact.layer_mm)[:, None] + _ORIGIN
    tissue = np.where(contact.inside[:, None], _SCATTER[behind_surface], _SURFACE[behind_surface])
    signal = gain * (tissue + _LAYER[behind_layer])
    noise = rng.standard_normal(signal.shape, np.float32) * np.float32(_NOISE)
    # Rounded apart, rows of a still needle differ in few bins and compress.
    return np.clip(np.rint(_BACKGROUND + signal) + np.rint(noise), 0, 255, dtype=np.float32)


def sensor_readings(
    contact: NeedleContact, start_s: float, gain: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Readings (row, 1026) that follow each other at 650 Hz: force in N, then the A-scan.

    The number of rows is a multiple of `READINGS_PER_SCAN`. The force drifts slowly.
    """
    fresh = slice(None, None, READINGS_PER_SCAN)
    seen = NeedleContact(*(values[fresh] for values in vars(contact).values()))
    scans = np.repeat(a_scans(seen, gain, rng), READINGS_PER_SCAN, axis=0)
    time = start_s + np.arange(len(scans)) / READING_HZ
    drift = _FORCE_DRIFT_N * np.sin(2 * np.pi * _FORCE_DRIFT_HZ * time)
    force = contact.force_n + drift + _FORCE_NOISE_N * rng.standard_normal(len(scans))
    # A force amplifier resolves 1 mN; the quantised values also compress.
    force = np.rint(force * 1000) / 1000
    return np.concatenate([force[:, None].astype(np.float32), scans], axis=1)


_ORIGIN: Final = 2 * A_SCAN_BINS


def _peak(height: float, width_bins: float) -> NDArray[np.float32]:
    offset = np.arange(-_ORIGIN, 2 * A_SCAN_BINS + 1)
    return (height * np.exp(-0.5 * (offset / width_bins) ** 2)).astype(np.float32)


def _scatter(height: float, decay_bins: float) -> NDArray[np.float32]:
    """Scattered light behind the surface, with the tissue's fixed grain."""
    offset = np.arange(-_ORIGIN, 2 * A_SCAN_BINS + 1)
    grain = 1 + 0.15 * np.sin(0.19 * offset) * np.sin(0.043 * offset + 1)
    decay = height * np.exp(-np.maximum(offset, 0) / decay_bins) * grain
    return np.where(offset >= 0, decay, 0).astype(np.float32)


_SCATTER: Final = _scatter(60.0, 180.0)
_SURFACE: Final = _SCATTER + _peak(130.0, 14.0)
_LAYER: Final = _peak(80.0, 18.0)
