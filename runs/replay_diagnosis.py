"""What a replay shows, in plain words: latencies, buffers, what was fused and what was not."""

import math
from dataclasses import dataclass

import numpy as np

from runs.flight_log import FlightLog
from runs.replay import Replay, gnss_delay
from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2 import parameters as prm
from systems.signals import sensor_log as logs

_NO_ORIGIN = 1e5  # m, innovations of a position on the earth from none
_LATE_LIMIT = 100.0  # ms, an observation older than that behind the horizon is never fused

# Kind of sample: what it is called, its aiding sources, its delay parameter, what switches it on.
_SENSORS = {
    logs.GNSS: ("GNSS", ("gnss_pos", "gnss_vel", "gnss_hgt"), prm.EKF2_GPS_DELAY, "EKF2_GPS_CTRL"),
    logs.BAROMETER: ("the barometer", ("baro_hgt",), prm.EKF2_BARO_DELAY, "EKF2_BARO_CTRL"),
    logs.MAGNETOMETER: ("the magnetometer", ("mag",), prm.EKF2_MAG_DELAY, ""),
    logs.RANGE_FINDER: ("the range finder", ("rng_hgt",), prm.EKF2_RNG_DELAY, "EKF2_RNG_CTRL"),
    logs.EXTERNAL_VISION: (
        "vision",
        ("ev_pos", "ev_hgt", "ev_vel", "ev_yaw"),
        prm.EKF2_EV_DELAY,
        "EKF2_EV_CTRL",
    ),
}
GATES = {
    "mag": prm.EKF2_MAG_GATE,
    "gnss_vel": prm.EKF2_GPS_V_GATE,
    "gnss_pos": prm.EKF2_GPS_P_GATE,
    "gnss_hgt": prm.EKF2_GPS_P_GATE,
    "baro_hgt": prm.EKF2_BARO_GATE,
    "rng_hgt": prm.EKF2_RNG_GATE,
    "ev_yaw": prm.EKF2_HDG_GATE,
    "ev_vel": prm.EKF2_EVV_GATE,
    "ev_pos": prm.EKF2_EVP_GATE,
    "ev_hgt": prm.EKF2_EVP_GATE,
}


@dataclass(frozen=True)
class SourceSummary:
    """One aiding source: how many observations, and what became of them."""

    name: str
    observations: int
    fused: int
    rejected: int
    test_ratio: float  # median over the observations of the worst axis
    nis: float  # mean normalised innovation squared of an axis, of what was fused; 1 is right


def source_rows(replay: Replay, name: str) -> np.ndarray:
    """The observations of a source, shape (n, axes, AID_COLUMNS)."""
    source = at.AID_NAMES.index(name)
    rows = replay.aid[replay.aid[:, 2] == source]
    return rows.reshape(-1, at.AID_AXES[source], rows.shape[1])


def summaries(replay: Replay) -> list[SourceSummary]:
    """All sources that made observations; those without a sensor only where they were used."""
    result = []
    for name in at.AID_NAMES:
        rows = source_rows(replay, name)
        if not len(rows):
            continue
        fused = rows[:, 0, 12] > 0.5
        if name not in GATES and not fused.any():
            continue  # gravity, computed and not used beside GNSS
        with np.errstate(all="ignore"):
            squares = rows[fused][:, :, 7] ** 2 / rows[fused][:, :, 8]
            ratios = np.nanmax(np.nan_to_num(rows[:, :, 9]), axis=1)
        result.append(
            SourceSummary(
                name,
                len(rows),
                int(fused.sum()),
                int((rows[:, 0, 11] > 0.5).sum()),
                float(np.median(ratios)),
                float(np.mean(squares)) if squares.size else math.nan,
            )
        )
    return result


def horizon(replay: Replay) -> float:
    """How far the filter runs behind the newest IMU sample (ms), once its buffer is full."""
    late = replay.delayed[len(replay.delayed) // 2 :]
    return float(np.median(late[:, 0] - late[:, 1])) * 1e-3 if len(late) else math.nan


def diagnosis(log: FlightLog, replay: Replay, p: np.ndarray) -> list[str]:
    """Sentences, the most important first."""
    if not len(replay.delayed):
        return [
            "The filter never started: it waits for a second near rest, where the accelerometer "
            "shows 0.8 to 1.2 g and the gyro less than 15 deg/s."
        ]
    sentences: list[str] = []
    if log.start is not None:
        sentences.append(
            "The filter starts from the state that the one on board had "
            f"{1e-6 * (log.start.time - replay.output[0, 0]):.2f} s into the log; "
            "--start cold starts it anew."
        )
    step = 1e3 * float(replay.column("dt_ekf_avg")[-1])
    for kind in _SENSORS:
        sentences += _latency(log, replay, p, kind, horizon(replay), step)
    sentences += _alignment(replay)
    sentences += rejections(replay, p)
    _, imu = log.samples.of(logs.IMU)
    gaps = np.diff(imu[:, 0]) * 1e-3
    typical = float(np.median(gaps))
    holes = gaps[gaps > 5.0 * typical]
    if len(holes):
        sentences.append(
            f"The IMU has {len(holes)} holes, the longest {holes.max():.0f} ms (a sample normally "
            f"comes every {typical:.1f} ms): the filter does not see what happened in them."
        )
    return sentences or ["Nothing conspicuous."]


def _latency(
    log: FlightLog, replay: Replay, p: np.ndarray, kind: int, horizon_ms: float, step: float
) -> list[str]:
    name, sources, delay, switch = _SENSORS[kind]
    arrivals, rows = log.samples.of(kind)
    if not len(arrivals):
        return []
    if switch and p[prm.INDEX[switch]] == 0.0:
        return [f"The log has {name} ({len(arrivals)} samples), but {switch} is 0: it is not used."]
    own = gnss_delay(log.samples, p) if kind == logs.GNSS else 1e3 * float(p[delay])
    ages = (arrivals - rows[:, 0] + own) * 1e-3 + 0.5 * step
    age, oldest = float(np.median(ages)), float(np.quantile(ages, 0.99))
    observed = max(len(np.unique(source_rows(replay, s)[:, 0, 4])) for s in sources)
    sentences = []
    if oldest > horizon_ms:
        predict = 1e-3 * float(p[prm.EKF2_PREDICT_US])
        entries = math.ceil(oldest / step) + 2  # one for the ring's open end, one for jitter
        needed = 10 * math.ceil(entries * predict / 10.0)
        often = "every sample" if age > horizon_ms else "the oldest samples"
        fate = "is fused late" if age > horizon_ms else "are fused late"
        if age > horizon_ms + _LATE_LIMIT:
            fate = "is thrown away"
        advice = (
            f"raise EKF2_DELAY_MAX to {needed}" if entries <= 255 else "no buffer is long enough"
        )
        sentences.append(
            f"{_capital(name)} arrives {age:.0f} ms old ({oldest:.0f} ms at the 99th percentile), "
            f"your horizon is {horizon_ms:.0f} ms: {often} {fate}; {advice}."
        )
    span = (arrivals[-1] - arrivals[0]) * 1e-6
    if observed < 0.8 * len(arrivals):
        rate = (len(arrivals) - 1) / span if span > 0.0 else math.nan
        sentences.append(
            f"Of {len(arrivals)} samples of {name} ({rate:.1f} a second) {observed} reached the "
            "filter; the others came too fast for its buffer, too late, or before it was ready."
        )
    return sentences


def _alignment(replay: Replay) -> list[str]:
    start = replay.delayed[0, 0]
    sentences = []
    for flag, what in (("tilt_align", "its tilt"), ("yaw_align", "its heading")):
        known = replay.flag(flag)
        if not known.any():
            sentences.append(f"The filter never found {what}.")
            continue
        after = (replay.delayed[np.argmax(known), 0] - start) * 1e-6
        if after > 5.0:
            sentences.append(f"The filter knew {what} only {after:.1f} s after the log began.")
    horizontal = replay.column("hpos_valid") > 0.5
    if not horizontal.any():
        sentences.append("The filter never had a horizontal position.")
    return sentences


def rejections(replay: Replay, p: np.ndarray) -> list[str]:
    """What was rejected, when and why; runs of rejections of one source together."""
    start = replay.output[0, 0]
    found: list[tuple[int, str]] = []
    for name, gate_index in GATES.items():
        rows = source_rows(replay, name)
        rejected = rows[:, 0, 11] > 0.5 if len(rows) else np.zeros(0, dtype=bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[0], rejected.astype(int), [0]])))
        gate = max(float(p[gate_index]), 1.0)
        for first, last in zip(edges[::2], edges[1::2], strict=True):
            run = rows[first:last]
            ratios = np.nan_to_num(run[:, :, 9])
            worst = np.unravel_index(int(np.argmax(ratios)), ratios.shape)
            innovation, ratio = run[worst][7], float(ratios[worst])
            began, ended = ((run[i, 0, 0] - start) * 1e-6 for i in (0, -1))
            when = f"at {began:.1f} s" if last - first == 1 else f"{began:.1f} to {ended:.1f} s"
            many = "once" if last - first == 1 else f"{last - first} times"
            why = (
                "the filter had no origin yet, GNSS had not passed its checks"
                if name == "gnss_pos" and abs(innovation) > _NO_ORIGIN
                else f"axis {worst[1]} was {abs(innovation):.3g} off, "
                f"{gate * math.sqrt(ratio):.1f} "
                f"standard deviations where the gate is {gate:g}"
                if ratio > 1.0
                else "an earlier check of the source had failed"
            )
            found.append((int(last - first), f"{name} was rejected {many} {when}: {why}."))
    found.sort(key=lambda entry: -entry[0])
    sentences = [sentence for _, sentence in found[:10]]
    if len(found) > len(sentences):
        sentences.append(f"There were {len(found) - len(sentences)} more, shorter rejections.")
    return sentences


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
