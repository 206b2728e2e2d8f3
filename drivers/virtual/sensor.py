"""The virtual OS1: its metadata, and how its receiver turns what the beams meet into returns."""

import json

import numpy as np

from .mesh import Material
from .raycast import MAX_RANGE_M, MIRROR_COS, Hits

FIRMWARE = "v3.1.0"
FOV_DEG = 42.4  # from the top beam to the bottom one
BEAM_AZIMUTH_DEG = (4.22, 1.41, -1.41, -4.22)  # of four neighbouring beams; they fire side by side
BEAM_ORIGIN_MM = 15.806
MIN_RANGE_M = 0.4
LIDAR_PORT, IMU_PORT = 7502, 7503

# Share of the light that comes back from each material (diffuse, 865 nm).
ALBEDO = np.zeros(len(Material), np.float32)
for _material, _share in (
    ("ASPHALT", 0.14),
    ("SOIL", 0.28),
    ("CONCRETE", 0.38),
    ("BRICK", 0.32),
    ("WOOD", 0.42),
    ("METAL", 0.40),
    ("PAINT", 0.35),
    ("GLASS", 0.10),
    ("LEAF", 0.48),
    ("CLOTH", 0.36),
    ("RUBBER", 0.07),
    ("WATER", 0.03),
    ("PLASTIC", 0.40),
):
    ALBEDO[Material[_material]] = _share

RANGE_OF_10_PERCENT_M = 55.0  # a 10 % target square to the beam is detected nine times in ten at this range
DETECTION_SLOPE = 2.5  # of the log odds of detection over the log of the returned light
LOST_ANYWAY = 0.004
PANE_LOSS = 0.35  # of beams that have gone through a pane or by way of a puddle, beyond the light they lack
BEAM_SPREAD_RAD = 0.0031
EDGE_M = 0.25  # neighbouring ranges that differ by more meet an edge between them
MIXED_SHARE = 0.22  # of the pixels at an edge, whose beam straddles it
PULSE_M = 1.2  # surfaces nearer to one another than this give one return between them


def virtual_metadata(
    beams: int = 128,
    columns: int = 1024,
    rate_hz: int = 10,
    profile: str = "RNG19_RFL8_SIG16_NIR16",
    serial: int = 122300001234,
) -> str:
    """The JSON that an OS1 of this kind would answer; its angles differ a little with the serial number.

    Raises ValueError for a sensor that Ouster does not make.
    """
    if beams not in (32, 64, 128) or (columns, rate_hz) not in (
        (512, 10),
        (512, 20),
        (1024, 10),
        (1024, 20),
        (2048, 10),
    ):
        raise ValueError(f"there is no OS1-{beams} with {columns} columns at {rate_hz} Hz")
    altitude, azimuth = _beam_angles(beams, np.random.default_rng(serial))
    lidar_to_sensor = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 36.18, 0, 0, 0, 1]
    document = {
        "beam_intrinsics": {
            "beam_altitude_angles": altitude.round(2).tolist(),
            "beam_azimuth_angles": azimuth.round(2).tolist(),
            "beam_to_lidar_transform": [1, 0, 0, BEAM_ORIGIN_MM, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
            "lidar_origin_to_beam_origin_mm": BEAM_ORIGIN_MM,
        },
        "calibration_status": {"reflectivity": {"timestamp": "2025-01-15T08:00:00", "valid": True}},
        "config_params": _settings(f"{columns}x{rate_hz}", profile),
        "imu_intrinsics": {"imu_to_sensor_transform": [1, 0, 0, -2.441, 0, 1, 0, -9.725, 0, 0, 1, 7.533, 0, 0, 0, 1]},
        "lidar_data_format": _data_format(azimuth, columns, rate_hz, profile),
        "lidar_intrinsics": {"lidar_to_sensor_transform": lidar_to_sensor},
        "sensor_info": {
            "build_date": "2023-12-05T21:12:00Z",
            "build_rev": FIRMWARE,
            "image_rev": f"ousteros-image-prod-bootes-{FIRMWARE}",
            "initialization_id": 1000000 + serial % 1000000,
            "prod_line": f"OS-1-{beams}",
            "prod_pn": "VIRTUAL",
            "prod_sn": str(serial),
            "status": "RUNNING",
        },
    }
    return json.dumps(document, indent=1)


def _beam_angles(beams: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Altitude and azimuth of each beam (H,), degrees. An OS1-64 has every second beam of the 128."""
    row = np.arange(0, 128, 128 // beams)
    altitude = FOV_DEG / 2 - FOV_DEG / 127 * row + rng.normal(0, 0.25) + rng.normal(0, 0.02, beams)
    return altitude, np.resize(BEAM_AZIMUTH_DEG, beams) + rng.normal(0, 0.02, beams)


def _data_format(azimuth: np.ndarray, columns: int, rate_hz: int, profile: str) -> dict:
    return {
        "column_window": [0, columns - 1],
        "columns_per_frame": columns,
        "columns_per_packet": 16,
        "fps": rate_hz,
        "pixel_shift_by_row": np.rint(azimuth / 360 * columns).astype(int).tolist(),
        "pixels_per_column": len(azimuth),
        "udp_profile_imu": "LEGACY",
        "udp_profile_lidar": profile,
    }


def _settings(mode: str, profile: str) -> dict:
    return {
        "azimuth_window": [0, 360000],
        "columns_per_packet": 16,
        "lidar_mode": mode,
        "operating_mode": "NORMAL",
        "phase_lock_enable": False,
        "phase_lock_offset": 0,
        "signal_multiplier": 1,
        "timestamp_mode": "TIME_FROM_INTERNAL_OSC",
        "udp_dest": "127.0.0.1",
        "udp_port_imu": IMU_PORT,
        "udp_port_lidar": LIDAR_PORT,
        "udp_profile_imu": "LEGACY",
        "udp_profile_lidar": profile,
    }


def receive(hits: Hits, pixel_shift: np.ndarray, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """What the sensor reports of what its beams met.

    pixel_shift: (H,) columns. -> RANGE (H, W) uint32 mm (0 = no return), REFLECTIVITY uint8, SIGNAL and
    NEAR_IR uint16, and "object" (H, W) uint16: whose return it is (0 where there is none).
    """
    shape = hits.range_m.shape
    met = hits.object_id > 0
    r = np.where(met, hits.range_m, np.float32(1.0))
    albedo = ALBEDO[hits.material]
    cosine = np.maximum(hits.incidence, np.float32(0.02))
    light = hits.clarity * albedo * (0.1 + 0.9 * cosine) / (0.1 * (r / RANGE_OF_10_PERCENT_M) ** 2)
    detected = met & (rng.random(shape, np.float32) > _loss(hits, light, cosine))
    mixed_m, object_id = _straddle(r, hits.object_id, detected, pixel_shift, rng)
    noisy = mixed_m + _spread(r, cosine, hits.material) * rng.standard_normal(shape, np.float32)
    detected &= (noisy > MIN_RANGE_M) & (noisy < MAX_RANGE_M)
    range_mm = np.where(detected, np.rint(noisy * 1e3), 0).astype(np.uint32)
    shade = 1 + 0.08 * rng.standard_normal(shape, np.float32)
    reflectivity = np.where(detected, np.clip(100 * albedo * (0.35 + 0.65 * cosine) * shade, 1, 255), 0).astype(
        np.uint8
    )
    signal = np.where(detected, np.clip(18 * light * shade, 1, 65535), 0).astype(np.uint16)
    near_ir = np.where(met, 900 * albedo * (0.5 + 0.5 * cosine), 60) * shade
    return {
        "RANGE": range_mm,
        "REFLECTIVITY": reflectivity,
        "SIGNAL": signal,
        "NEAR_IR": np.clip(near_ir, 0, 4095).astype(np.uint16),
        "object": np.where(detected, object_id, 0).astype(np.uint16),
    }


def _loss(hits: Hits, light: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Chance that a beam which met something brings nothing back: weak light, panes, puddles."""
    odds = 9.0 * np.maximum(light, np.float32(1e-6)) ** np.float32(DETECTION_SLOPE)
    loss = LOST_ANYWAY + (1 - LOST_ANYWAY) / (1 + odds)
    loss[hits.clarity < 1] = 1 - (1 - PANE_LOSS) * (1 - loss[hits.clarity < 1])
    # Panes of moving cars, behind which nothing is cast.
    slanted = (hits.material == Material.GLASS) & (cosine < MIRROR_COS)
    loss[slanted] = np.float32(0.9)
    return loss


def _spread(range_m: np.ndarray, cosine: np.ndarray, material: np.ndarray) -> np.ndarray:
    """Standard deviation of a range, metres: timing, distance, the slanted footprint, moving leaves."""
    slant = np.sqrt(1 - np.minimum(cosine, 1) ** 2) / cosine
    footprint = np.minimum(0.06 * range_m * np.float32(BEAM_SPREAD_RAD) * slant, np.float32(0.04))
    leaf = np.where(material == Material.LEAF, np.float32(0.015), np.float32(0.0))
    return np.sqrt(np.float32(0.010**2) + (range_m * np.float32(0.03 / 100)) ** 2 + footprint**2 + leaf**2)


def _straddle(range_m, object_id, detected, pixel_shift, rng):
    """Beams that meet an edge: the one or the other surface, or something between -> range, object."""
    shape = range_m.shape
    candidate = np.flatnonzero(rng.random(shape, np.float32) < MIXED_SHARE)
    row, column = np.unravel_index(candidate, shape)
    across = rng.random(len(candidate)) < 0.6
    step = rng.choice([-1, 1], len(candidate))
    other_row = np.where(across, row, np.clip(row + step, 0, shape[0] - 1))
    # The beam above points the same way where its destaggered column is the same.
    other_column = np.where(across, column + step, column + pixel_shift[row] - pixel_shift[other_row]) % shape[1]
    neighbour = range_m[other_row, other_column]
    gap = neighbour - range_m[row, column]
    edge = (np.abs(gap) > EDGE_M) & detected[row, column] & detected[other_row, other_column]
    row, column, gap, neighbour = row[edge], column[edge], gap[edge], neighbour[edge]
    share = rng.random(len(row), np.float32)
    one_return = (np.abs(gap) < PULSE_M) | (rng.random(len(row)) < 0.12)
    out_range, out_object = range_m.copy(), object_id.copy()
    out_range[row, column] = np.where(
        one_return, range_m[row, column] + share * gap, np.where(share < 0.5, neighbour, range_m[row, column])
    )
    swapped = np.where(one_return, share > 0.5, share < 0.5)
    out_object[row, column] = np.where(swapped, object_id[other_row[edge], other_column[edge]], object_id[row, column])
    return out_range, out_object
