"""From a trained network to the pair that is committed: descriptor.onnx and its card descriptor.json."""

from __future__ import annotations

import copy
import hashlib
import json
import warnings
from pathlib import Path

import numpy as np
import onnxruntime
import torch

from .features import FEATURE_SHAPES
from .metrics import calibration_curve, rank_agreement
from .network import DESCRIPTOR_LENGTH, DescriptorNetwork
from .overlap import MARGIN_M
from .preprocess import BOTTOM_DEG, TOP_DEG

# Opset 17 with its file version is what onnxruntime 1.17, the oldest allowed, reads.
OPSET = 17
EXPORT_TOLERANCE = 1e-5

LIMITS = [
    "trained on virtual outdoor scans only, of one generator of worlds",
    "OS1 fields of view, 32 to 128 beams, full rotations; tilts beyond about 5 degrees were never seen",
    "an azimuth window counts as columns lost: its scans were trained on, against whole ones, but never measured",
    "sensor heights of 0.4 to 2.5 m above the ground",
    "overlap is that of a 64-beam reference sensor",
]


def write_model(
    network: DescriptorNetwork,
    out: Path,
    distance: np.ndarray,
    overlap: np.ndarray,
    data: dict,
    training: dict,
) -> None:
    """Writes out/descriptor.onnx, checked against torch, and its card with the calibration of (P,) pairs.

    RuntimeError if the exported file answers otherwise than the network.
    """
    path = out / "descriptor.onnx"
    difference = _export(network, path)
    knots, expected = calibration_curve(distance, overlap)
    error = np.abs(np.interp(distance, knots, expected) - overlap)
    card = {
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "input": {name: [1, *shape] for name, shape in FEATURE_SHAPES.items()},
        "elevation_deg": [TOP_DEG, BOTTOM_DEG],
        "output": {"shape": [1, DESCRIPTOR_LENGTH], "norm": 1},
        "parameters": sum(parameter.numel() for parameter in network.parameters()),
        "overlap": f"models/overlap.py, margin {MARGIN_M} m, reference sensor of 64 beams and 512 columns",
        "data": data,
        "training": training,
        "validation": {
            "pairs": len(distance),
            "spearman": round(rank_agreement(distance, overlap), 4),
            "overlap_mae": round(float(error.mean()), 4),
        },
        "export_max_difference": difference,
        "limits": LIMITS,
        "calibration": {
            "distance": [round(float(value), 5) for value in knots],
            "overlap": [round(float(value), 5) for value in expected],
        },
    }
    (out / "descriptor.json").write_text(json.dumps(card, indent=1) + "\n")


def _export(network: DescriptorNetwork, path: Path) -> float:
    """Writes the ONNX file; returns the largest difference between its answers and the network's."""
    network = copy.deepcopy(network).eval()
    random = torch.Generator().manual_seed(0)
    scans = {name: torch.rand(8, *shape, generator=random) for name, shape in FEATURE_SHAPES.items()}
    with warnings.catch_warnings(), torch.no_grad():
        # The newer exporter writes opsets and file versions that the oldest allowed onnxruntime cannot read.
        warnings.simplefilter("ignore")
        torch.onnx.export(
            network,
            tuple(view[:1] for view in scans.values()),
            path,
            input_names=list(scans),
            output_names=["descriptor"],
            opset_version=OPSET,
            dynamo=False,
        )
        wanted = network(**scans).numpy()
    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    singly = [{name: view[i : i + 1].numpy() for name, view in scans.items()} for i in range(len(wanted))]
    found = np.concatenate([session.run(None, scan)[0] for scan in singly])
    difference = float(np.abs(found - wanted).max())
    if difference > EXPORT_TOLERANCE:
        raise RuntimeError(f"{path} differs from the network by {difference:.2g}, allowed {EXPORT_TOLERANCE:.0e}")
    return difference
