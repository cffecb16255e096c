"""From the camera's frame to the local one: where the pad is, seen from the vehicle."""

import math
from typing import Literal

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import (
    BasicVector,
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

from plants.svgs_beacons import SvgsBeaconsConfig
from systems.configuration import Finite, Positive, Vector3, configuration
from systems.estimators.fused_sensor import POLL_PERIOD
from systems.frames import quaternion_from_rotation_vector, rotation_matrix
from systems.signals.measurement import (
    SVGS,
    TARGET_MEASUREMENT,
    TIME_OF_ARRIVAL,
    VEHICLE_ESTIMATE,
    no_measurement,
)
from systems.vision.pinhole import camera_mount

SVGS_SOURCE = 4.0  # bit 2 of TargetMeasurement.source

# Indices of the layouts as the compiled functions read them; a test holds them to the layouts.
_S_BEACON, _S_P, _S_Q, _S_COVARIANCE = 4, 7, 10, 14
_E_Q, _E_TIME = 4, 0
_T_P, _T_COVARIANCE, _T_SOURCE = 4, 7, 13

# The history of attitudes: entries of time (s) and quaternion, the newest at `memory[0]`.
_ENTRIES = 40  # times 20 ms: 0.8 s, longer than any packet takes
_ENTRY = 5
_SEEN, _NEWEST, _FIRST = 0, 1, 2
MEMORY_SIZE = _FIRST + _ENTRIES * _ENTRY


@configuration
class SvgsTransformationsConfig:
    """Lemma 1, and what is known of the attitude."""

    beacons: SvgsBeaconsConfig = Field(default_factory=SvgsBeaconsConfig)
    camera_position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    camera_yaw: Finite = 0.0  # rad, turn of the camera about z_B
    # The attitude of the camera: the autopilot's alone (as published), or together with the
    # beacon's, which is known to stand upright
    attitude: Literal["vehicle", "fused"] = "fused"
    # rad, one sigma an axis of the autopilot's tilt. It is no help to trust it much: what is
    # measured with the filter's own tilt tells the filter nothing of its error, and from 100 m a
    # degree is 1.7 m of position that it would follow.
    tilt_noise: Positive = 0.02

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "SvgsTransformations":
        """Add a block called `name` to `builder`."""
        return builder.AddNamedSystem(name, SvgsTransformations(self, seed))


@njit(cache=True)
def attitude_at(memory, time, q):
    """The attitude at `time` (s) from the history, interpolated, into q (4,)."""
    newest = int(memory[_NEWEST])
    after = _FIRST + newest * _ENTRY
    q[:] = memory[after + 1 : after + 5]
    for back in range(1, _ENTRIES):
        at = _FIRST + ((newest - back) % _ENTRIES) * _ENTRY
        if memory[at] < 0.0:
            break
        if memory[at] <= time:
            span = memory[after] - memory[at]
            part = min(max((time - memory[at]) / max(span, 1e-9), 0.0), 1.0)
            dot = 0.0
            for i in range(1, 5):
                dot += memory[at + i] * memory[after + i]
            sign = 1.0 if dot >= 0.0 else -1.0
            norm = 0.0
            for i in range(4):
                q[i] = (1.0 - part) * memory[at + 1 + i] + part * sign * memory[after + 1 + i]
                norm += q[i] * q[i]
            q /= math.sqrt(norm)
            return
        after = at
        q[:] = memory[after + 1 : after + 5]


@njit(cache=True)
def pad_from_pose(pose, q_WB, X_BC, placements, tilt_noise, fused, out):
    """Where the pad's centre is from the vehicle's origin, in W.

        p_BT_W = R_WB (R_BC p_CT + p_BC)                       Lemma 1 (Eq. 6), then to W
        p_BP_W = p_BT_W − R_z(yaw_WP) p_PT

    With `fused` the camera's attitude R_WC is turned by a part w of the tilt δ that would make
    the beacon stand upright, w = σ_v²/(σ_v² + σ_s²) with the noise of the vehicle's tilt σ_v and
    of the pose's σ_s.

    Parameters
    ----------
    pose : array of the layout SVGS
    q_WB : array of shape (4,)
        At the pose's time of validity.
    X_BC : array of shape (3, 4)
        The camera's mount.
    placements : array of shape (3, 4)
        Of the beacons: position in P (m), yaw (rad).
    tilt_noise : float
        σ_v, rad.
    fused : bool
    out : array of shape (9,)
        Overwritten: p_BP_W (m), covariance xx, xy, yy, xz, yz, zz (m²).
    """
    beacon = int(pose[_S_BEACON])
    R_WB = rotation_matrix(q_WB)
    R_WC = R_WB @ np.ascontiguousarray(X_BC[:, :3])
    R_CT = rotation_matrix(pose[_S_Q : _S_Q + 4])
    S = np.empty((6, 6))
    k = _S_COVARIANCE
    for i in range(6):
        for j in range(i, 6):
            S[i, j] = S[j, i] = pose[k]
            k += 1
    tilt_variance = tilt_noise * tilt_noise
    if fused:
        R_WT = R_WC @ R_CT
        up = R_WT[:, 2]
        turn_W = R_WC @ np.ascontiguousarray(S[3:, 3:]) @ np.ascontiguousarray(R_WC.T)
        seen = 0.5 * (turn_W[0, 0] + turn_W[1, 1])
        weight = tilt_variance / (tilt_variance + seen)
        # δ × up = z − up for small angles
        delta = weight * np.array([up[1], -up[0], 0.0])
        R_WC = rotation_matrix(quaternion_from_rotation_vector(delta)) @ R_WC
        tilt_variance *= 1.0 - weight
    R_WT = R_WC @ R_CT
    yaw = math.atan2(R_WT[1, 0], R_WT[0, 0]) - placements[beacon, 3]
    c, s = math.cos(yaw), math.sin(yaw)
    p_CT_W = R_WC @ np.ascontiguousarray(pose[_S_P : _S_P + 3])
    arm = R_WB @ np.ascontiguousarray(X_BC[:, 3])
    x, y = placements[beacon, 0], placements[beacon, 1]
    out[0] = p_CT_W[0] + arm[0] - (c * x - s * y)
    out[1] = p_CT_W[1] + arm[1] - (s * x + c * y)
    out[2] = p_CT_W[2] + arm[2] - placements[beacon, 2]
    P = R_WC @ np.ascontiguousarray(S[:3, :3]) @ np.ascontiguousarray(R_WC.T)
    # An error δ of the tilt moves the beacon by δ × p, δ level.
    px, py, pz = p_CT_W[0], p_CT_W[1], p_CT_W[2]
    P[0, 0] += tilt_variance * pz * pz
    P[1, 1] += tilt_variance * pz * pz
    P[2, 2] += tilt_variance * (px * px + py * py)
    P[0, 2] -= tilt_variance * pz * px
    P[1, 2] -= tilt_variance * pz * py
    out[3], out[4], out[5] = P[0, 0], P[0, 1], P[1, 1]
    out[6], out[7], out[8] = P[0, 2], P[1, 2], P[2, 2]


@njit(cache=True)
def transform_step(pose, estimate, X_BC, placements, tilt_noise, fused, memory, output):
    """Keep the newest attitude; turn a new pose into a `TARGET_MEASUREMENT`.

    Parameters
    ----------
    pose, estimate : arrays of the layouts SVGS and VEHICLE_ESTIMATE
    X_BC, placements, tilt_noise, fused
        As in `pad_from_pose`.
    memory : array of shape (MEMORY_SIZE,)
        Changed in place.
    output : array of the layout TARGET_MEASUREMENT
        Changed in place.
    """
    newest = int(memory[_NEWEST])
    if estimate[_E_TIME] > memory[_FIRST + newest * _ENTRY]:
        newest = (newest + 1) % _ENTRIES
        memory[_NEWEST] = newest
        at = _FIRST + newest * _ENTRY
        memory[at] = estimate[_E_TIME]
        memory[at + 1 : at + 5] = estimate[_E_Q : _E_Q + 4]
    if pose[TIME_OF_ARRIVAL] == memory[_SEEN] or pose[_S_BEACON] < 0.0:
        return
    memory[_SEEN] = pose[TIME_OF_ARRIVAL]
    q = np.empty(4)
    attitude_at(memory, pose[0], q)
    out = np.empty(9)
    pad_from_pose(pose, q, X_BC, placements, tilt_noise, fused, out)
    output[:4] = pose[:4]
    output[_T_P : _T_P + 9] = out
    output[_T_SOURCE] = SVGS_SOURCE


class SvgsTransformations(LeafSystem):
    """Rotates the beacon's pose into the local frame, with the attitude of its own time.

    .. pydrake_system::
        name: SvgsTransformations
        input_ports:
        - pose
        - estimate
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | `pose` | `SVGS` | a beacon in the camera's frame; taken once per time of arrival |
    | `estimate` | `VEHICLE_ESTIMATE` | the vehicle's attitude |
    | `measurement` | `TARGET_MEASUREMENT` | the pad's centre from the vehicle, source SVGS |

    The node `transformations_drspider` of "High-altitude precision landing by SVGS" (Drones 8,
    37, 2024, Lemma 1). Equations in `pad_from_pose`. The attitude is that of the pose's time of
    validity, from a history of 0.8 s. Its error is correlated from pose to pose, which the
    covariance does not say.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | keep the attitude, take a new pose |
    """

    def __init__(self, config: SvgsTransformationsConfig, seed: int = 0):
        """A block; it draws no random numbers, `seed` is for uniformity."""
        super().__init__()
        self.configure(config, seed)
        self._pose = self.DeclareVectorInputPort("pose", SVGS.size).Eval
        self._estimate = self.DeclareVectorInputPort("estimate", VEHICLE_ESTIMATE.size).Eval
        measurement = self.DeclareDiscreteState(BasicVector(no_measurement(TARGET_MEASUREMENT)))
        memory = np.zeros(MEMORY_SIZE)
        memory[_SEEN] = -1.0
        memory[_FIRST::_ENTRY] = -1.0
        self.DeclareDiscreteState(BasicVector(memory))
        self.DeclareStateOutputPort("measurement", measurement)
        self.DeclarePeriodicDiscreteUpdateEvent(POLL_PERIOD, 0.0, self._update)

    def configure(self, config: SvgsTransformationsConfig, seed: int = 0) -> None:
        """Take over a new configuration; every field may change."""
        self.config = config
        self._X_BC = camera_mount(config.camera_position, config.camera_yaw)
        self._placements = config.beacons.placements()

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        transform_step(
            self._pose(context),
            self._estimate(context),
            self._X_BC,
            self._placements,
            self.config.tilt_noise,
            self.config.attitude == "fused",
            discrete_state.get_mutable_value(1),
            discrete_state.get_mutable_value(0),
        )
