"""Names of a scene's shapes, the choice by ``--shapes``, and the warning about floors."""

import numpy as np
import pytest

from mi_ntf.core import scene_shapes
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.scene_shapes import SceneShape

CUBE = SceneShape("cube")
NAMES = "cow", "cube", "floor"


def test_shapes_are_called_by_id_file_or_type():
    cow, robe = SceneShape("obj", "cow", "meshes/a.obj"), SceneShape("ply", file="meshes/robe.ply")
    shapes = scene_shapes.named([cow, robe, CUBE])
    assert [shape.name for shape in shapes] == ["cow", "robe", "cube"]
    assert [str(shape) for shape in shapes] == ["cow (obj)", "robe (ply)", "cube"]
    assert str(SceneShape("rectangle", holds="emitter")) == "rectangle (area light)"


def test_repeated_names_are_numbered_around_those_that_exist():
    shapes = [CUBE, SceneShape("obj", "cube2"), CUBE, SceneShape("serialized", file="a.serialized"), CUBE]
    assert [shape.name for shape in scene_shapes.named(shapes)] == ["cube1", "cube2", "cube3", "a", "cube4"]


@pytest.mark.parametrize(("text", "chosen"), [
    ("", [True, True, True]), ("cow", [True, False, False]), ("floor, cow", [True, False, True]),
    ("not:floor", [True, True, False]), ("not:cow,cube", [False, False, True]),
])
def test_choice(text, chosen):
    assert scene_shapes.choose(text, NAMES) == chosen


@pytest.mark.parametrize(("text", "message"), [
    ("cow,lawn", "no shape is called 'lawn'; the scene has cow, cube, floor"),
    ("not:floors", "no shape is called 'floors'; the scene has cow, cube, floor"),
    ("not:cow,cube,floor", "is 'not:cow,cube,floor', which leaves no shape; the scene has cow, cube, floor"),
    (",", "is ',', which leaves no shape"),
])
def test_a_choice_of_nothing_names_what_there_is(text, message):
    with pytest.raises(MiNtfError, match=f"--shapes:? {message}"):
        scene_shapes.choose(text, NAMES)


def test_lists_are_short():
    assert scene_shapes.listed(["point", "cow (obj)", "point"]) == "2 × point, cow (obj)"
    assert scene_shapes.listed(range(12)) == "0, 1, 2, 3, 4, 5, 6, 7, and 4 more"
    assert scene_shapes.listed([]) == "nothing"


OBJECT, HAT = ((-1, 0, -1), (1, 2, 1)), ((-0.2, 2, -0.2), (0.2, 2.4, 0.2))
FLOOR, WALL = ((-4, 0, -4), (4, 0, 4)), ((-4, 0, -4), (4, 6, -3.9))
ROOM, PLATE = ((-4, -4, -4), (4, 4, 4)), ((-1.5, -0.1, -1.5), (1.5, 0, 1.5))
BUMPS, POLE = ((-9, -1, -9), (9, 1, 9)), ((-0.1, 2, -0.1), (0.1, 20, 0.1))


def _warning(**boxes):
    low, high = np.array(list(boxes.values()), np.float64).swapaxes(0, 1)
    return scene_shapes.warning([SceneShape("obj", name, name=name) for name in boxes], low, high)


def test_floors_and_rooms_are_named_with_the_option_that_leaves_them_out():
    assert _warning(cow=OBJECT, floor=FLOOR) == (
        "warning: floor (obj) is 3.3 times as large as the other shapes together, which become small in the "
        "photographs; --shapes not:floor leaves it out")
    assert "--shapes not:floor,wall leaves them out" in _warning(floor=FLOOR, cow=OBJECT, wall=WALL, hat=HAT)
    assert "not:ground leaves it out" in _warning(cow=OBJECT, ground=BUMPS)
    assert "not:room,floor leaves them out" in _warning(cow=OBJECT, room=ROOM, floor=FLOOR)


@pytest.mark.parametrize("boxes", [
    {"cow": OBJECT}, {"floor": FLOOR}, {"cow": OBJECT, "hat": HAT}, {"cow": OBJECT, "plate": PLATE},
    {"cow": OBJECT, "pole": POLE}, {"floor": FLOOR, "wall": WALL}, {"cow": OBJECT, "label": ((1, 0, 0), (1, 1, 1))},
])
def test_parts_of_an_object_are_no_floor(boxes):
    """A pole is long, a plate is small, and where all is flat nothing is a floor."""
    assert _warning(**boxes) == ""
