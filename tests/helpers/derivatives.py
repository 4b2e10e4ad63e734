"""Derivatives of a picture by a scene parameter: Dr.Jit's in both modes, and central differences."""

import drjit as dr
import mitsuba as mi
import numpy as np

WEIGHTS = [1.0, 0.6, -0.4]
"""Of the colour channels in the scalar that is differentiated: none cancels another."""


def value(scene, parameters, seed=3):
    """Weighted mean over the picture that prefers its upper right: no symmetry hides an error. Derivatives are taken
    with the random numbers of seed 3, which may not be the picture's own."""
    image = mi.render(scene, parameters, seed=seed, seed_grad=3 if seed != 3 else 4)[..., :3]
    height, width = image.shape[:2]
    y, x = np.mgrid[:height, :width]
    weights = (1 + x / width - 0.5 * y / height)[..., None] * np.array(WEIGHTS)
    return dr.mean(image * mi.TensorXf(weights.astype(np.float32)), axis=None)


def forward(scene, parameters, name, direction, kind):
    """The derivative of :func:`value` as `name`, a `kind`, moves along `direction`, in forward mode."""
    return _attached(scene, parameters, name, direction, kind, lambda t, result: (dr.forward(t), dr.grad(result).array))


def backward(scene, parameters, name, direction, kind):
    """The same in reverse mode."""
    return _attached(scene, parameters, name, direction, kind, lambda t, result: (dr.backward(result), dr.grad(t)))


def differences(scene, parameters, name, direction, kind, step):
    """The same by central differences."""
    original, found = kind(parameters[name]), []
    for sign in (1, -1):
        _move(parameters, name, original, mi.Float(sign * step), direction)
        found.append(float(value(scene, parameters).array[0]))
    _move(parameters, name, original, mi.Float(0), direction)
    return (found[0] - found[1]) / (2 * step)


def _attached(scene, parameters, name, direction, kind, derive):
    original, t = kind(parameters[name]), mi.Float(0)
    dr.enable_grad(t)
    _move(parameters, name, original, t, direction)
    slope = float(derive(t, value(scene, parameters, 4))[1][0])
    _move(parameters, name, original, mi.Float(0), direction)
    return slope


def _move(parameters, name, original, t, direction) -> None:
    """Set `name` to `original`, moved by `t` along `direction`: a transform is shifted."""
    if isinstance(original, mi.Transform4f):
        parameters[name] = mi.Transform4f().translate(t * mi.Vector3f(direction)) @ original
    else:
        parameters[name] = original + t * type(original)(direction)
    parameters.update()
