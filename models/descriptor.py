"""The scan descriptor at run time: numpy and onnxruntime, one thread.

A descriptor is a unit vector of 256 numbers; the Euclidean distance between two of them falls as the
overlap of their scans grows (overlap.py says what overlap is), whichever way the sensor faced.
"""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import numpy as np

# From release 1.29 on, onnxruntime's Linux wheels tell its maker about each model and machine, and keep a device id
# in ~/.cache. It looks for this before anything is loaded. A robot's daemon speaks to nobody but its sensor.
os.environ["ORT_DISABLE_TELEMETRY"] = "1"
import onnxruntime  # noqa: E402

from .features import FEATURE_SHAPES, features  # noqa: E402
from .preprocess import Resampler  # noqa: E402

DESCRIPTOR_LENGTH = 256
DEFAULT_MODEL = Path(__file__).with_name("descriptor.onnx")


class ModelError(Exception):
    """A model that cannot be used here; the message says which file, what was found and what was wanted."""


class DescriptorModel:
    """A loaded model. `model_id` names it: descriptors of different ids must never be compared.

    card: the model card as read from the JSON file beside the model.
    """

    def __init__(self, session: onnxruntime.InferenceSession, model_id: str, card: dict):
        self.model_id = model_id
        self.card = card
        self._session = session
        curve = card["calibration"]
        self._distances = np.asarray(curve["distance"], np.float64)
        self._overlaps = np.asarray(curve["overlap"], np.float64)
        self._resampler: tuple[tuple, Resampler] | None = None

    @classmethod
    def load(cls, path: Path | None = None) -> DescriptorModel:
        """The committed model, or the .onnx at `path` with its .json card beside it; ModelError if unfit."""
        path = DEFAULT_MODEL if path is None else Path(path)
        try:
            content = path.read_bytes()
            card = json.loads(path.with_suffix(".json").read_text())
        except OSError as error:
            raise ModelError(f"cannot read model {error.filename}: {error.strerror}") from error
        except ValueError as error:
            raise ModelError(f"model card {path.with_suffix('.json')} is not JSON: {error}") from error
        digest = hashlib.sha256(content).hexdigest()
        _check_card(path, card, digest)
        return cls(_open_session(path, content), digest[:12], card)

    def describe(self, range_mm: np.ndarray, pixel_shift: np.ndarray, altitude_rad: np.ndarray) -> np.ndarray:
        """(256,) float32 unit vector of one scan.

        range_mm: (H, W) uint32 mm, staggered, 0 = no return; pixel_shift: (H,) int destagger shift;
        altitude_rad: (H,) beam altitudes, row 0 on top. ValueError if W is not a multiple of 256.
        """
        image = self._resampler_for(pixel_shift, altitude_rad, range_mm.shape[1])(range_mm)
        return self._session.run(None, {name: view[None] for name, view in features(image).items()})[0][0]

    def overlap_from_distance(self, distance: np.ndarray | float) -> np.ndarray | float:
        """Expected overlap, in [0, 1], of two scans whose descriptors lie `distance` apart."""
        return np.interp(distance, self._distances, self._overlaps)

    def distance_from_overlap(self, overlap: np.ndarray | float) -> np.ndarray | float:
        """The largest descriptor distance at which the expected overlap is still `overlap`."""
        return np.interp(overlap, self._overlaps[::-1], self._distances[::-1])

    def _resampler_for(self, pixel_shift: np.ndarray, altitude_rad: np.ndarray, n_columns: int) -> Resampler:
        # One sensor per program: its tables are kept, and another sensor's replace them.
        key = (np.asarray(pixel_shift).tobytes(), np.asarray(altitude_rad).tobytes(), n_columns)
        if self._resampler is None or self._resampler[0] != key:
            self._resampler = (key, Resampler(pixel_shift, altitude_rad, n_columns))
        return self._resampler[1]


def _check_card(path: Path, card: dict, digest: str) -> None:
    if not isinstance(card, dict) or not {"sha256", "calibration"} <= card.keys():
        raise ModelError(f"model card {path.with_suffix('.json')} lacks sha256 or calibration")
    if card["sha256"] != digest:
        raise ModelError(
            f"model {path} has sha256 {digest[:12]}..., its card is of {str(card['sha256'])[:12]}...: restore the pair"
        )
    _check_curve(path.with_suffix(".json"), card["calibration"])


def _check_curve(card_path: Path, curve: object) -> None:
    try:
        distances, overlaps = (np.asarray(curve[name], np.float64) for name in ("distance", "overlap"))
    except (TypeError, KeyError, ValueError) as error:
        raise ModelError(
            f"model card {card_path}: calibration wants two lists of numbers, distance and overlap"
        ) from error
    if distances.ndim != 1 or distances.shape != overlaps.shape or distances.size < 2:
        raise ModelError(f"model card {card_path}: calibration wants two lists of one length, 2 or more")
    if not (np.diff(distances) > 0).all() or not (np.diff(overlaps) <= 0).all():
        raise ModelError(f"model card {card_path}: calibration is not monotone")


def _open_session(path: Path, content: bytes) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    options.inter_op_num_threads = 1
    options.execution_mode = onnxruntime.ExecutionMode.ORT_SEQUENTIAL
    # A spinning pool would burn a core between two scans.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    options.add_session_config_entry("session.inter_op.allow_spinning", "0")
    try:
        session = onnxruntime.InferenceSession(content, options, providers=["CPUExecutionProvider"])
    except Exception as error:  # onnxruntime raises a dozen unrelated classes for one unusable file
        raise ModelError(f"onnxruntime cannot load model {path}: {error}") from error
    inputs = {value.name: list(value.shape) for value in session.get_inputs()}
    outputs = [list(value.shape) for value in session.get_outputs()]
    wanted_inputs = {name: [1, *shape] for name, shape in FEATURE_SHAPES.items()}
    if inputs != wanted_inputs or outputs != [[1, DESCRIPTOR_LENGTH]]:
        raise ModelError(
            f"model {path} maps {inputs} to {outputs}, want {wanted_inputs} to [[1, {DESCRIPTOR_LENGTH}]]:"
            " restore the model that came with this version"
        )
    return session
