"""LPIPS, the one metric that needs PyTorch and learned weights. Nothing is ever downloaded."""

import functools
import warnings
from pathlib import Path

import numpy as np

from .. import doctor
from .metrics import NotMeasured, need_pixels, srgb

BACKBONE = "alexnet-owt-7be5be79.pth"
"""torchvision's AlexNet, trained on ImageNet; looked for where PyTorch keeps what it downloads."""
SMALLEST = 31
"""Pixels along a side below which AlexNet's last layers would be empty."""


def lpips(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """LPIPS (Zhang et al. 2018, AlexNet, version 0.1) of the sRGB-encoded, clipped images; 0 is perfect.

    Arguments as in :mod:`.metrics`. With a mask, the mean of its pixels in the map of all layers, each brought to the
    image's size. Raises :class:`NotMeasured` below 31×31 pixels, and where the package ``lpips`` or the weights of
    AlexNet are missing.
    """
    need_pixels(image, SMALLEST)
    network = _network()
    import torch

    planes = [torch.from_numpy(np.asarray(srgb(i), np.float32).transpose(2, 0, 1).copy())[None]
              for i in (image, reference)]
    network.spatial = mask is not None
    with torch.inference_mode():
        found = network(*planes, normalize=True)[0, 0].numpy()
    return float(found.mean() if mask is None else found[mask].mean())


@functools.cache
def _network():
    """The metric with its learned weights. Raises NotMeasured."""
    try:
        import lpips
        import torch
    except ModuleNotFoundError as error:
        raise NotMeasured(f"package {error.name} is missing", doctor.pip_install("[lpips]")) from None
    except (ImportError, OSError, RuntimeError) as error:  # of a torchvision that was built for another PyTorch
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
            # Random weights first, those of the file below: asked for trained ones, torchvision would download them.
            network = lpips.LPIPS(net="alex", pnet_rand=True, verbose=False)
        own = {name: trained[".".join(["features", *name.split(".")[2:]])]  # net.slice2.3.bias → features.3.bias
               for name in network.state_dict() if name.startswith("net.")}
        network.load_state_dict(own, strict=False)
    except Exception as error:  # pickle's, zip's, PyTorch's own: whatever a damaged file makes of them
        raise NotMeasured(f"{file} does not hold the weights of AlexNet ({type(error).__name__})",
                          f"put https://download.pytorch.org/models/{BACKBONE} in its place") from None
    return network.eval()
