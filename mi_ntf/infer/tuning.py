"""Constants that were tuned on pictures rather than derived.

Opaque fields were tuned on the scenes `statue`, `globe`, `knot` and `skull`, smoke on `cloud`, under point lights and
environments. A field unit is a radius of the unit sphere, a camera cell a step of the camera's march (2/samples). The
fields' skins are 0.01 to 0.03 field units thick.
"""

SKIN_CELL = 1.3
"""Longest step, scale heights of the thinner skins; others are fractions of it. Tuned on the error of marches, 0.1 %:
`statue`, trained by photographs of 256² and of 512²."""

VOXEL = 0.9
"""Longest edge of a voxel, scale heights of the thinner skins. Tuned on ribs at the rims of shadows: `statue`, trained
by photographs of 256² and of 512²."""

# Camera march: least time to equal noise or error.
SAMPLE_FRACTION = 1 / 8
"""Fraction of a ray's light that one sample stands for, where the field has opaque skins. Tuned on time to equal noise:
`statue`, `knot`, `skull`."""
SMOKE_SAMPLE_FRACTION = 1 / 64
"""The same for fields without opaque skins whose rays meet many normals. Tuned on time to equal noise: `cloud` under 1,
8 and 128 lights."""
PIECES = 3
"""Pieces of a cell, each with exponential density. Tuned on brightness against 16 pieces: the four opaque fields."""

# Light march: error of pictures against steps of a sixth.
NODE = 0.48
"""Place in a step at which its density is evaluated, fraction of the step from the shading point on. It is below one
half since skins thin out towards the light. Tuned on brightness: `statue`, `globe`, `skull`."""
FIRST_STEP = 0.35
"""Shortest step, camera cells; beside the point, whose skin makes the depth."""
LONGEST_STEP = 1 / 80
"""Longest step, field units, less than half an octant of a brick; longer steps jump over thin parts."""
STEP_GROWTH = 0.3
"""Largest step, fraction of the distance from the point."""
GROWTH_PER_CELL = 57.6
"""Upper bound of the same per length of a camera cell, 1/field unit, so that the march converges with fine cells."""
GRADIENT_STEP = 1 / 512
"""Longest step for derivatives, field units. Tuned on their error against finite differences."""

# Marches that fill maps.
NETWORK_STEP = 0.93
"""Step for the ray network's inputs, camera cells. Tuned on `statue`; no simple fraction, as steps that end on the
voxels' borders depend on rounding."""
MAP_STEP = 0.97
"""Step for maps of one logistic, camera cells; maps of two take half of it."""

# Maps of lights.
MIN_MAP_RESOLUTION, FINE_MAPS = 192, 16
"""Least texels along a side of a map; number of lights up to which maps are as fine as the voxels. Tuned on the fill
time, less than a second for the 2.4 million texels of 16 maps of 384²: `statue` under 1 to 64 lights."""
SAME_SURFACE, TWO_SURFACES = 1.0, 2.0
"""Differences of the centres of four neighbouring rays, in texels, up to which they meet one surface, and from which
they meet two. Tuned on `statue`, 256², 20 lights."""

# Atlas: error of pictures against marches.
ATLAS_SIDE = 36
"""Square root of the number of directions. Tuned on `globe` and `statue` under environments."""
ATLAS_RESOLUTION = 51
"""Texels along the side of a direction's map; 51 MiB in all."""
STRATA, STRATUM = 4, 2.75
"""Least number of strata of √t of the sum close to the point, and their greatest mean length in steps. Tuned on τ: the
four opaque fields."""
BEGIN = 0.08
"""Distance from the point at which the map of an opaque field begins, field units; some skins of the point away."""
REACH = 0.064
"""Distance from the point at which the sum close to it ends, field units; it lacks the skin's tail."""
NEAREST_PIVOT = 0.16
"""Least distance of the pivot from the point, field units."""
PIVOT = 0.7
"""Distance of the pivot, fraction of the way to the middle of the chord. Tuned on `globe` and `statue`."""
ATLAS_STEP = 7.0
"""Step of the march that fills an opaque field's maps, in steps of a transmittance map. Tuned on the blur of texels:
`statue`, `globe`, `knot`."""
SMOKE_STEP = 1 / 32
"""Least step of the same for smoke, field units. Tuned on τ: `cloud`."""

# Refinement of a field by gradient descent.
STEP_LENGTHS = {"albedo": 0.02, "specular": 0.02, "roughness": 0.02, "density": 0.15, "log_density": 0.15}
"""Length of a step by parameter, before steps shorten; for both densities that of ln σ. Tuned on `statue` before its
last training, 100 photographs of 256² by flash: error of a relit picture after four minutes."""
EARLIER_GRADIENTS = 3
"""Number of mean squared gradients with which the sums of all voxels begin, since a first gradient is mostly noise."""

MARCH_CHANCE = 1 / 16
"""Chance of a march that corrects a lookup. Its cost is this fraction of marching everywhere, its noise four times the
lookup's error."""
