"""LPIPS, the one metric that needs PyTorch and learned weights. Nothing is ever downloaded."""

import functools
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .. import doctor
from .metrics import NotMeasured, need_pixels, srgb

if TYPE_CHECKING:
    from lpips import LPIPS

BACKBONE = "alexnet-owt-7be5be79.pth"
"""File of torchvision's AlexNet, trained on ImageNet, in the folder of PyTorch's downloads."""
SMALLEST = 31
"""Least pixels along a side; the last layers of AlexNet would be empty below."""


def lpips(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return LPIPS (Zhang et al. 2018, AlexNet, version 0.1) of the sRGB-encoded, clipped images; 0 is perfect.

    Arguments are those of :mod:`.metrics`. With a mask, the mean is over its pixels in the map of all layers, each
    resized to the image. Raises :class:`NotMeasured` below 31×31 pixels, and where the package ``lpips`` or the weights
    of AlexNet are missing.
    """
    need_pixels(image, SMALLEST)
    network = _network()
    import torch

    planes = [torch.from_numpy(np.asarray(srgb(i), np.float32).transpose(2, 0, 1).copy())[None]
              for i in (image, reference)]
    network.spatial = mask is not None
    with torch.inference_mode():
        distance = network(*planes, normalize=True)[0, 0].numpy()
    return float(distance.mean() if mask is None else distance[mask].mean())


@functools.cache
def _network() -> "LPIPS":
    """Return the metric with its learned weights. Raises NotMeasured."""
    try:
        import lpips
        import torch
    except ModuleNotFoundError as error:
        raise NotMeasured(f"package {error.name} is missing", doctor.pip_install("[lpips]")) from None
    except (ImportError, OSError, RuntimeError) as error:  # torchvision was built for another PyTorch
        raise NotMeasured(f"package lpips does not load ({str(error).splitlines()[0]})",
                          "install the torchvision that belongs to the installed PyTorch") from None
    file = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONE
    if not file.is_file():
        raise NotMeasured("the weights of AlexNet are missing",
                          f"put https://download.pytorch.org/models/{BACKBONE} into {file.parent}")
    try:
        trained = torch.load(file, map_location="cpu", weights_only=True)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lpips calls torchvision by its old arguments
            # Random weights first, then those of the file, since torchvision would download trained ones.
            network = lpips.LPIPS(net="alex", pnet_rand=True, verbose=False)
        weights = {name: trained[".".join(["features", *name.split(".")[2:]])]  # net.slice2.3.bias → features.3.bias
                   for name in network.state_dict() if name.startswith("net.")}
        network.load_state_dict(weights, strict=False)
    except Exception as error:  # of pickle, zip or PyTorch, for a damaged file
        raise NotMeasured(f"{file} does not hold the weights of AlexNet ({type(error).__name__})",
                          f"put https://download.pytorch.org/models/{BACKBONE} in its place") from None
    return network.eval()
