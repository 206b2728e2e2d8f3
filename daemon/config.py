"""Settings: every parameter with its unit, default and the study or source behind it."""

from __future__ import annotations

import hashlib
import json
import sys
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from ..drivers.sensor_setup import SensorWish

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


class ConfigError(Exception):
    """The settings cannot be used: one line per problem, each naming file, key, value and what is allowed."""


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class SensorConfig(_Section):
    """A live sensor, and how it is set, by its own names; "", 0 or []: as it is. It is always set to send here."""

    address: str = Field("", description="its host name or address, with :port where its HTTP is not at 80")
    lidar_mode: Literal["", "512x10", "512x20", "1024x10", "1024x20", "2048x10", "4096x5"] = Field(
        "", description="columns x rotations/s"
    )
    udp_profile_lidar: Literal[
        "",
        "LEGACY",
        "RNG15_RFL8_NIR8",
        "RNG15_RFL8_NIR8_DUAL",
        "RNG19_RFL8_SIG16_NIR16",
        "RNG19_RFL8_SIG16_NIR16_DUAL",
    ] = Field("", description="what a packet carries; RNG15 takes a third of RNG19's network and rounds ranges to 8 mm")
    timestamp_mode: Literal["", "TIME_FROM_INTERNAL_OSC", "TIME_FROM_SYNC_PULSE_IN", "TIME_FROM_PTP_1588"] = Field(
        "", description="what the sensor's clock follows; the internal one counts from its power-up"
    )
    azimuth_window_mdeg: list[int] = Field(
        [], description="[from, to], millidegrees: columns outside are not sent; the whole turn is [0, 360000]"
    )
    udp_port_lidar: int = Field(0, ge=0, le=65535, description="port here that the sensor sends to")
    persist: bool = Field(False, description="whether the sensor keeps these settings beyond its next power-up")

    @field_validator("azimuth_window_mdeg")
    @classmethod
    def _two_angles(cls, window: list[int]) -> list[int]:
        if window and not (len(window) == 2 and all(0 <= angle <= 360_000 for angle in window)):
            raise ValueError("two angles from 0 to 360000, or none")
        return window

    @property
    def wish(self) -> SensorWish:
        """The same for the drivers."""
        return SensorWish(
            lidar_mode=self.lidar_mode or None,
            udp_profile_lidar=self.udp_profile_lidar or None,
            timestamp_mode=self.timestamp_mode or None,
            azimuth_window=tuple(self.azimuth_window_mdeg) or None,
            udp_port_lidar=self.udp_port_lidar or None,
            persist=self.persist,
        )


class GateConfig(_Section):
    """Which frames are good enough to be used."""

    min_valid_ratio: float = Field(
        0.9, gt=0, le=1, description="share of a frame's columns that must have arrived (ouster-ros practice)"
    )


class OdometryConfig(_Section):
    """KISS-ICP (RA-L 2023)."""

    voxel_size_m: float = Field(
        1.0, gt=0, description="local map voxel, KISS-ICP's default; 0.8 takes 1.7 times as long for the same error"
    )
    max_range_m: float = Field(80.0, gt=0, description="returns beyond are not registered; also the local map's radius")
    min_range_m: float = Field(1.0, ge=0, description="returns nearer are the robot itself")
    max_points: int = Field(
        16_400,
        ge=1000,
        description="pixels given to KISS-ICP, a regular sub-grid of the image; key scans are refined by all of theirs",
    )
    max_speed_mps: float = Field(20.0, gt=0, description="faster is not believed: odometry is lost")
    max_turn_dps: float = Field(270.0, gt=0, description="turning faster is not believed: odometry is lost")
    min_overlap: float = Field(
        0.4, ge=0, le=1, description="share of what stands that must have stood a frame ago; below: odometry is lost"
    )


class KeyScanConfig(_Section):
    """Which scans are kept."""

    distance_m: float = Field(0.5, gt=0, description="a scan is kept each time the robot moved so far")
    angle_deg: float = Field(20.0, gt=0, description="... or turned so far")
    interval_s: float = Field(10.0, gt=0, description="... or so much time has passed (a standing robot still sees)")


class SceneConfig(_Section):
    """Scene identification (CDSD Algorithm 1)."""

    alpha_m2: float = Field(120.0, gt=0, description="largest area of a scene (CDSD Table III)")
    min_overlap: float = Field(
        0.1,
        ge=0,
        le=1,
        description="least overlap expected of two scans of a scene; the paper's beta is the distance of descriptors at"
        " which the model's card expects it",
    )
    margin_m: float = Field(
        2.5, gt=0, description="a scene is its hull grown by this: a straight path has an area, a second lane is inside"
    )
    exit_margin_m: float = Field(
        1.0, ge=0, description="a visit ends this far beyond the margin (no flicker on the rim)"
    )
    max_visit_s: float = Field(
        120.0, gt=0, description="a visit that lasts longer is cut, so that results come while there"
    )


class SubmapConfig(_Section):
    """OptMap: which scans represent a scene."""

    k: int = Field(12, ge=2, description="scans in a submap at alpha = 120 m2 (8-12 by study)")
    range_m: float = Field(25.0, gt=0, description="returns farther from their sensor are not compared")


class AlignmentConfig(_Section):
    """Registration of key scans to the scene's first visit, and to the key scans before: point to plane."""

    cell_m: float = Field(0.5, gt=0, description="a scan's returns are summed up in cells of this size")
    voxel_m: float = Field(
        0.25, gt=0, description="voxel of both clouds where a key scan is looked for in earlier maps (GICP)"
    )
    range_m: float = Field(60.0, gt=0, description="returns farther away are not registered")
    gate_m: float = Field(0.6, gt=0, description="pairs farther apart are not matched: changes do not pull")
    coarse_gate_m: float = Field(3.0, gt=0, description="... in a second attempt, after a large drift")
    drift_ratio: float = Field(
        0.01, ge=0, description="drift expected per metre since the last fix: how far out a scene is looked for"
    )
    plane_voxel_m: float = Field(
        0.5, gt=0, description="voxel of the maps of planes; 0.8 takes two thirds of the time, and drifts a third more"
    )
    local_scans: int = Field(120, ge=2, description="key scans that this map remembers: 60 m of path")
    min_inlier_ratio: float = Field(
        0.6,
        gt=0,
        le=1,
        description="share of the scan that must lie where the first visit met something (mostly 0.9)",
    )
    max_residual_m: float = Field(
        0.12, gt=0, description="root mean square distance to the reference's surface, at most"
    )


class DetectionConfig(_Section):
    """Change detection between two submaps (CDSD section III-C)."""

    tau_m: float = Field(
        0.3, gt=0, description="mean distance to n neighbours beyond which a point is a candidate (Table II)"
    )
    n: int = Field(5, ge=1, description="neighbours; 1 to 5 make no difference by study")
    rho_m: float = Field(
        0.15, gt=0, description="noise filter: mean distance to n neighbours among candidates, at most"
    )
    ground_sigmas: float = Field(
        3.0, gt=0, description="Mahalanobis distance to the ground plane below which a point is ground"
    )
    ground_min_sigma_m: float = Field(
        0.035, gt=0, description="floor of the ground's spread: range noise and pose error"
    )
    occlusion_range_m: float = Field(18.0, gt=0, description="a scan farther away confirms nothing")
    occlusion_margin_m: float = Field(
        0.3, gt=0, description="how far behind a point a return must lie to have passed through it"
    )
    min_confirming_scans: int = Field(2, ge=1, description="scans that must have looked through the place of a change")
    min_showing_scans: int = Field(
        3, ge=1, description="scans of its own visit that must have met a thing: walkers are met once or twice"
    )
    min_showing_s: float = Field(
        2.0, ge=0, description="seconds between the first and the last of them: a slow car covers a place for less"
    )
    cluster_distance_m: float = Field(0.4, gt=0, description="points nearer than this belong to one object")
    min_points: int = Field(25, ge=1, description="confirmed points (5 cm voxels) that an object must have")
    ground_filter_c1_m: float = Field(0.15, gt=0, description="B1: distance of an object's mean to the ground plane")
    ground_filter_c2: float = Field(0.9, gt=0, description="B2: Bhattacharyya covariance term")


class WorkerConfig(_Section):
    """The detection thread."""

    queue_size: int = Field(
        8, ge=1, description="instances that may wait; a live robot drops the newest beyond, and counts it"
    )
    timeout_s: float = Field(120.0, gt=0, description="an instance that takes longer is ended and recorded as failed")


class StorageConfig(_Section):
    """The data directory: how large it may grow, and the backups of what was found."""

    quota_gb: float = Field(
        50.0,
        gt=0,
        description="10^9 bytes that the data directory may take, 150 km of key scans; the least useful go first",
    )
    min_free_gb: float = Field(
        2.0, ge=0, description="10^9 bytes to stay free on its file system, for the robot's other programs"
    )
    backup_interval_h: float = Field(
        1.0, gt=0, description="hours between two backups of changes.db, where it has changed; one at each stop, too"
    )
    backups_kept: int = Field(24, ge=1, description="backups of changes.db, the newest")


class Config(_Section):
    """All settings of revisitd."""

    sensor: SensorConfig = SensorConfig()
    gate: GateConfig = GateConfig()
    odometry: OdometryConfig = OdometryConfig()
    keyscans: KeyScanConfig = KeyScanConfig()
    scenes: SceneConfig = SceneConfig()
    submaps: SubmapConfig = SubmapConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    detection: DetectionConfig = DetectionConfig()
    worker: WorkerConfig = WorkerConfig()
    storage: StorageConfig = StorageConfig()

    @property
    def digest(self) -> str:
        """First 12 hex digits of the SHA-256 of all values: names the settings a change was found with."""
        return hashlib.sha256(self.model_dump_json().encode()).hexdigest()[:12]


def load_config(path: Path | None) -> Config:
    """Settings of a TOML file over the defaults; defaults alone without a file.

    Raises ConfigError with one line per problem.
    """
    if path is None:
        return Config()
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise ConfigError("\n".join(f"{path}: {_problem(item)}" for item in error.errors())) from error


def _problem(item: dict[str, Any]) -> str:
    key = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        known = sorted(_fields_at(item["loc"][:-1]))
        return f"{key}: unknown setting; known here: {', '.join(known)}"
    return f"{key} = {item['input']!r}: {item['msg'][0].lower()}{item['msg'][1:]}"


def _fields_at(location: tuple[Any, ...]) -> list[str]:
    model: type[BaseModel] = Config
    for part in location:
        model = model.model_fields[part].annotation
    return list(model.model_fields)


def dump_config(config: Config) -> str:
    """The settings as commented TOML that load_config reads back."""
    lines = []
    for section, value in config:
        lines += [f"# {type(value).__doc__}", f"[{section}]"]
        for name, field in type(value).model_fields.items():
            lines.append(f"# {field.description}")
            lines.append(f"{name} = {json.dumps(getattr(value, name))}")  # of these values also TOML
        lines.append("")
    return "\n".join(lines)
