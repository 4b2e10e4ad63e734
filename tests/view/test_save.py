"""A saved scene is the scene that was seen."""

import asyncio
import dataclasses
import re
from xml.etree import ElementTree as ET

import mitsuba as mi
import numpy as np
import pytest
from helpers.viewed import CONSTANT, DIRECTIONAL, ENVIRONMENT, POINT, SECOND, SPOT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.render.scene.environment_option import Environment
from mi_ntf.view import environments
from mi_ntf.view.controls import Controls
from mi_ntf.view.save import save
from mi_ntf.view.session import Session

SAME = 1e-4
"""Relative RMSE. The file has nine digits, and float32 rounds them again."""


def fresh(path, **define):
    return np.array(mi.render(mi.load_file(str(path), **define), spp=1, seed=0))


def change(view):
    """Change one thing of each kind."""
    point, second, spot, directional, sky = view.lights
    point.move([-2.0, 3.5, 3.0])
    second.dim(3)
    spot.move([1.0, 4.0, 4.0])
    spot.point([-0.5, -4.2, -3.7])
    directional.point([1, -1, -1])
    sky.turn(70)
    sky.dim(0.5)
    view.look(dataclasses.replace(view.pose, origin=(-2.0, 1.0, 5.0)))
    view.choose(max_depth=3)


def test_a_saved_scene_is_the_one_that_was_seen(scene, tmp_path):
    """The saved file is in another folder than field and sky."""
    view = Session(scene(POINT, SECOND, SPOT, DIRECTIONAL, ENVIRONMENT), {"visibility": "raymarch"}, 32)
    before = view.refine().image
    change(view)
    shown = view.refine().image
    save(view, tmp_path / "new" / "saved.xml", camera=True)
    assert relative_rmse(before, shown) > 0.2
    assert relative_rmse(fresh(tmp_path / "new" / "saved.xml"), shown) < SAME


def test_only_what_was_changed_is_written_anew(scene, tmp_path):
    view = Session(scene(POINT, SECOND), {}, 32)
    view.lights[1].move([1.0, 2.0, 3.0])
    save(view, view.path.with_name("saved.xml"))
    old, new = (ET.parse(view.path.with_name(name)).getroot() for name in ("scene.xml", "saved.xml"))

    def lines(root):
        return [(e.tag, tuple(sorted(e.attrib.items()))) for e in root.iter()]

    only_old, only_new = set(lines(old)) - set(lines(new)), set(lines(new)) - set(lines(old))
    assert only_old == {("point", (("name", "position"), ("x", "-2.5"), ("y", "2"), ("z", "3")))}
    assert only_new == {("point", (("name", "position"), ("x", "1"), ("y", "2"), ("z", "3"))),
                        ("path", (("value", "."),))}


def test_the_scenes_own_camera_is_saved_unless_the_present_one_is_asked_for(scene):
    view = Session(scene(POINT), {}, 32)
    own, out = fresh(view.path), view.path.with_name("saved.xml")
    view.look(dataclasses.replace(view.pose, origin=(-2.0, 1.0, 5.0)))
    present = view.refine().image
    save(view, out)
    assert relative_rmse(fresh(out), own) == 0
    save(view, out, camera=True)
    assert relative_rmse(fresh(out), present) < SAME < relative_rmse(own, present)


@pytest.mark.parametrize("lines", [('<path value="."/>',), ('<path value="."/>', '<include filename="extra.xml"/>')])
def test_the_folder_of_the_scene_is_searched_once(scene, lines):
    path = scene(POINT, *lines)
    path.with_name("extra.xml").write_text(f'<scene version="3.9.0"><path value="."/>{SECOND}</scene>')
    out = path.with_name("saved.xml")
    save(Session(path, {}, 32), out)
    assert [p.get("value") for p in ET.parse(out).iter("path")] == ["."]


@pytest.mark.parametrize(("lights", "option"), [
    ((ENVIRONMENT,), {"rotate": 30.0, "scale": 2.0}), ((ENVIRONMENT,), {"file": "other.exr", "rotate": -40.0}),
    ((POINT,), {"file": "other.exr", "scale": 0.5}), ((CONSTANT,), {"scale": 0.5}),
    ((CONSTANT,), {"file": "other.exr", "rotate": 70.0})])
def test_an_environment_of_the_command_line_is_seen_and_saved(scene, lights, option):
    """Later changes in the view add to it."""
    path = scene(*lights)
    given = Environment(**option | ({"file": path.with_name(option["file"])} if "file" in option else {}))
    view = Session(path, {}, 32, given)
    light = next(light for light in view.lights if light.kind in ("envmap", "constant"))
    shown, out = view.refine().image, path.with_name("saved.xml")
    assert relative_rmse(fresh(path), shown) > 0.01
    save(view, out)
    assert relative_rmse(fresh(out), shown) < SAME
    light.dim(3)
    if light.can_turn:
        light.turn(50)
    changed = view.refine().image
    save(view, out)
    assert relative_rmse(fresh(out), changed) < SAME < relative_rmse(shown, changed)


def test_names_of_the_scene_keep_their_use(scene):
    view = Session(scene(POINT), {"visibility": "raymarch"}, 32)
    out = view.path.with_name("saved.xml")
    save(view, out)
    assert '<default name="visibility" value="raymarch" />' in out.read_text()
    view.choose(visibility="none")
    save(view, out)
    assert '<default name="visibility" value="none" />' in out.read_text()
    assert relative_rmse(fresh(out, visibility="raymarch"), fresh(view.path, visibility="raymarch")) == 0


def test_lights_of_included_files_are_saved(scene):
    path = scene('<default name="light" value="two"/><include filename="light_$light.xml"/>')
    for name, light in (("one", POINT), ("two", SECOND)):
        path.with_name(f"light_{name}.xml").write_text(f'<scene version="3.9.0">{light}</scene>')
    view = Session(path, {"light": "one"}, 32)
    view.lights[0].move([-2.0, 3.5, 3.0])
    save(view, path.with_name("saved.xml"))
    assert relative_rmse(fresh(path.with_name("saved.xml")), view.refine().image) < SAME


def test_the_environment_is_swapped(scene):
    """Earlier changes stay: a moved light, a turned sky."""
    view = Session(scene(POINT, ENVIRONMENT), {}, 32)
    view.lights[0].move([-2.0, 3.5, 3.0])
    view.lights[1].turn(40)
    before = view.refine().image
    other = next(p for p in environments.beside(view) if p.name == "other.exr")
    environments.swap_environment(view, other)
    shown = view.refine().image
    view.lights[1].turn(60)
    turned = view.refine().image
    save(view, view.path.with_name("saved.xml"))
    assert '"other.exr"' in view.path.with_name("saved.xml").read_text()
    truth = fresh(view.path.with_name("saved.xml"))
    assert relative_rmse(turned, truth) < SAME
    assert min(relative_rmse(before, shown), relative_rmse(shown, turned)) > 0.01


def test_the_first_choice_is_the_scenes_own_environment(scene):
    view = Session(scene(ENVIRONMENT), {}, 32)
    assert [p.name for p in environments.beside(view)] == ["sky.exr", "other.exr"]


def test_mistakes_are_told(scene, tmp_path):
    view = Session(scene(POINT), {}, 32)
    with pytest.raises(MiNtfError, match="is the scene that is being viewed; choose another name"):
        save(view, view.path)
    with pytest.raises(MiNtfError, match="the scene has no environment map to swap"):
        environments.swap_environment(view, tmp_path / "sky.exr")
    view = Session(scene(ENVIRONMENT), {}, 32)
    with pytest.raises(MiNtfError, match="is no picture that Mitsuba reads"):
        environments.swap_environment(view, view.path)


def test_a_page_saves_beside_the_scene_alone(scene, tmp_path):
    controls = Controls(Session(scene(POINT), {}, 32), port=8290)
    try:
        folder = controls.session.path.parent
        for name in ("../out.xml", str(tmp_path / "out.xml"), "deep/out.xml", "blobs.safetensors", "out", ".", ""):
            with pytest.raises(MiNtfError, match=r"name is .*; scenes are saved beside the opened one: give a name"):
                controls._save(name, False)
        scene(SECOND, name="other.xml")
        for name in ("other.xml", "scene.xml"):
            with pytest.raises(MiNtfError, match=rf"{name} exists, and this view did not write it; choose"):
                controls._save(name, False)
        (folder / "out.xml").unlink(missing_ok=True)
        for _ in range(2):
            controls._save("out.xml", False)
        assert (folder / "out.xml").is_file()
        assert not list(tmp_path.iterdir()) and not (folder.parent / "out.xml").exists()
    finally:
        controls.server.stop()


def test_the_error_is_announced_before_it_is_measured(scene):
    controls = Controls(Session(scene(POINT), {}, 32), port=8291)
    try:
        asyncio.run(controls._on_error_button(None))  # nothing renders: the loop of this view was not started
        assert "Measuring the error against raymarch" in controls._answer.content
        controls.viewer.step()
        assert re.search(r"Error against raymarch: transmittance_map \d+\.\d\d %", controls._answer.content)
    finally:
        controls.server.stop()
