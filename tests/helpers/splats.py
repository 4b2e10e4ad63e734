"""Gaussian splats that cover a mesh, and their files."""

import gzip
from pathlib import Path

import numpy as np
import trimesh

from mi_ntf.core.splats import Splats

LAYERS = 8.0
"""Mean number of splats over a point of the surface: its area counts as 2π s² for each."""


def on_mesh(mesh: trimesh.Trimesh, count: int, flatness: float = 0.4, opacity: float = 0.9, colour=(0.6, 0.5, 0.4),
            seed: int = 0) -> Splats:
    """Return `count` flat discs that cover `mesh`, uniformly distributed.

    `flatness`: shortest over longest axis. Every disc is tangential and turned about the normal by chance. It lies two
    standard deviations beneath the surface, where grazing rays meet an opaque layer.
    """
    rng = np.random.default_rng(seed)
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=seed)
    normals = np.asarray(mesh.face_normals)[faces]
    radius = np.sqrt(LAYERS * mesh.area / count / (2 * np.pi))
    points = np.asarray(points) - 2 * flatness * radius * normals
    scales = np.tile([radius, radius, flatness * radius], (count, 1))
    half = np.stack([1 + normals[:, 2], -normals[:, 1], normals[:, 0], np.zeros(count)], 1)  # turns z to the normal
    half[half[:, 0] < 1e-6] = [0, 1, 0, 0]
    angle = rng.uniform(0, np.pi, count)
    quaternions = _product(half / np.linalg.norm(half, axis=1, keepdims=True),
                           np.stack([np.cos(angle), 0 * angle, 0 * angle, np.sin(angle)], 1))
    return Splats(np.array(points), scales, quaternions, np.full(count, opacity), np.tile(colour, (count, 1)))


def write_ply(path: Path, splats: Splats) -> Path:
    """Write `splats` as Gaussian splatting does; the colours become those of spherical harmonics of degree 0."""
    names = ["x", "y", "z", "nx", "ny", "nz", *(f"f_dc_{i}" for i in range(3)), "opacity",
             *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    alpha = splats.opacities
    srgb = np.where(splats.colours <= 0.0031308, 12.92 * splats.colours, 1.055 * splats.colours ** (1 / 2.4) - 0.055)
    columns = [splats.centres, np.zeros((len(splats), 3)), (srgb - 0.5) / 0.28209479177387814,
               np.log(alpha / (1 - alpha))[:, None], np.log(splats.scales), splats.rotations]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(splats)}",
              *(f"property float {name}" for name in names), "end_header", ""]
    path.write_bytes("\n".join(header).encode() + np.concatenate(columns, 1).astype("<f4").tobytes())
    return path


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the products of quaternions (n, 4), w first."""
    w = a[:, :1] * b[:, :1] - np.sum(a[:, 1:] * b[:, 1:], axis=1, keepdims=True)
    return np.concatenate([w, a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])], 1)


def spz_bytes(splats: Splats, version: int = 2) -> bytes:
    """Return the content of an ``.spz`` file of version 1, 2 or 3, rounded as the format does."""
    n = len(splats)
    place = splats.centres.astype("<f2").view(np.uint8).reshape(n, 6) if version == 1 else (
        np.round(splats.centres * 4096).astype("<i4").view(np.uint8).reshape(n, 3, 4)[..., :3].reshape(n, 9))
    srgb = np.where(splats.colours <= 0.0031308, 12.92 * splats.colours, 1.055 * splats.colours ** (1 / 2.4) - 0.055)
    colour = np.round(((srgb - 0.5) / 0.28209479177387814 * 0.15 + 0.5) * 255)
    scale = np.round((np.log(splats.scales) + 10) * 16)
    turn = splats.rotations[:, [1, 2, 3, 0]] * np.where(splats.rotations[:, :1] < 0, -1, 1)
    rotation = _three_bytes(splats.rotations) if version < 3 else _smallest_three(turn)
    header = np.zeros(1, [("magic", "S4"), ("version", "<u4"), ("n", "<u4"), ("rest", "u1", 4)])
    header["magic"], header["version"], header["n"], header["rest"] = b"NGSP", version, n, [0, 12, 0, 0]
    parts = [place, np.round(255 * splats.opacities), colour, scale, rotation]
    return gzip.compress(header.tobytes() + b"".join(np.clip(p, 0, 255).astype(np.uint8).tobytes() for p in parts))


def _three_bytes(rotations: np.ndarray) -> np.ndarray:
    return np.round((rotations[:, 1:] * np.where(rotations[:, :1] < 0, -1, 1) + 1) * 127.5)


def _smallest_three(turn: np.ndarray) -> np.ndarray:
    """Return 32 bits of each quaternion (x, y, z, w): number of the largest, and nine bits and sign of the others."""
    words = []
    for quaternion in turn:
        largest = int(np.argmax(np.abs(quaternion)))
        quaternion = quaternion * np.sign(quaternion[largest])
        word = largest
        for component in [c for c in range(4) if c != largest]:
            size = int(511 * min(abs(quaternion[component]) / np.sqrt(0.5), 1) + 0.5)
            word = word << 10 | int(quaternion[component] < 0) << 9 | size
        words.append(word)
    return np.array(words, "<u4").view(np.uint8).reshape(len(turn), 4)
