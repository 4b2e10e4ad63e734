"""A view's controls in a browser (viser). Nothing is fetched from, or shared with, another machine."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
import viser
from viser import transforms

from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.visibility import names
from mi_ntf.page_server import Background, serve

from . import environments
from .camera import Pose, fov_of_window, triple
from .display import Bytes
from .lights import Light
from .picture import Interrupted
from .save import beside_scene, save
from .session import AOVS, Session
from .viewer import Viewer

LIGHT, NOTHING = "light", "–"
LINES = """<div style="height: 2.9em; overflow-y: auto; padding: 0.2em 0.9em; font-size: 0.85em; line-height: 1.4;
white-space: pre-line; opacity: {opacity}">{text}</div>"""
"""Two lines of text. Their height is fixed, so that no control moves under the mouse."""
NARROW = "<style>@media (max-width: 36em) { [style*='max-height: 60%'] { max-height: 33% !important } }</style>"
"""Style that leaves two thirds of a narrow window to the picture. viser's panel would take 60 %."""
HELP = "Left button: orbit, right: pan, wheel: zoom. Drag a light's handles to move it."
T = TypeVar("T")


@dataclass
class Gizmo:
    """Handles of a light in the scene, and the numbers on the page that show its position."""

    handles: viser.TransformControlsHandle
    position: viser.GuiVector3Handle | None = None


class Controls:
    """The page of `session` at `host`:`port`, or the next free port. Its address is ``url``."""

    def __init__(self, session: Session, host: str = "127.0.0.1", port: int = 8080, samples: int = 64) -> None:
        self.session = session
        self.server, self.url = serve(f"mi-ntf: {session.path.name}", host, port)
        self.background = Background(self.server)
        self._cameras: dict[int, tuple[Pose, tuple[int, int]]] = {}  # pose and window of each browser, by its number
        self._saved: set[Path] = set()
        self.gizmos: dict[str, Gizmo] = {}
        self.viewer = Viewer(session, self._show, self._tell, samples,
                             lambda: {name: gizmo.handles.position for name, gizmo in self.gizmos.items()})
        self._set_camera()
        self._status = self.server.gui.add_html(NARROW)
        self._answer = self.server.gui.add_html(LINES.format(text=HELP, opacity=0.6))
        self._add_camera_folder()
        self._add_picture_folder()
        for light in session.lights:
            self._add_light_folder(light)
        self._add_environments()
        self._add_file_folder()

    def run(self) -> None:
        """Serve until :meth:`stop`, rendering in this thread."""
        self.viewer.change("opened", lambda: None)
        try:
            self.viewer.run()
        finally:
            self.server.stop()

    def stop(self) -> None:
        """End :meth:`run`."""
        self.viewer.stop()

    def _show(self, picture: Bytes, status: str) -> None:
        self.background.show(picture)
        self._status.content = NARROW + LINES.format(text=html.escape(status), opacity=1)

    def _tell(self, text: str) -> None:
        self._answer.content = LINES.format(text=html.escape(text), opacity=1)

    def _set_camera(self) -> None:
        pose, initial = self.session.pose, self.server.initial_camera
        self.server.scene.set_up_direction(pose.up)
        initial.up, initial.position, initial.look_at = (np.array(v) for v in (pose.up, pose.origin, pose.target))
        initial.fov = float(np.radians(pose.fov))

        async def follow(client: viser.ClientHandle) -> None:
            client.camera.on_update(self._on_camera)
            await self._on_camera(client.camera)  # viser has already passed the first message on

        self.server.on_client_connect(follow)

    async def _on_camera(self, view: viser.CameraHandle) -> None:
        """Follow the browser's camera and window. A window narrower than the scene's picture shows its whole width."""
        fov = fov_of_window(self.session.initial_pose.fov, self.session.aspect, view.aspect)
        view.fov = float(np.radians(fov))
        turn = transforms.SO3(np.array(view.wxyz)).as_matrix()
        position, window = np.array(view.position, np.float64), (view.image_width, view.image_height)
        distance = float(np.linalg.norm(np.array(view.look_at) - position))
        pose = Pose(triple(position), triple(position + distance * turn[:, 2]), triple(-turn[:, 1]), fov)
        if self._cameras.get(view.client.client_id) == (pose, window):
            return
        self._cameras[view.client.client_id] = pose, window

        def do() -> None:
            self.session.fit(*window)
            self.session.look(pose)

        self.viewer.change("camera", do, "camera")

    def _add_camera_folder(self) -> None:
        gui = self.server.gui
        with gui.add_folder("Camera"):
            gui.add_button("Scene's camera").on_click(self._return_to_scene)
            gui.add_button("See all lights", hint="step back until they are in view").on_click(self._step_back)

    def _add_picture_folder(self) -> None:
        gui, viewer, session = self.server.gui, self.viewer, self.session
        with gui.add_folder("Picture"):
            visibility = gui.add_dropdown("visibility", tuple(names()), initial_value=session.settings.visibility)
            depth = gui.add_number("max_depth", session.settings.max_depth, min=-1, max=64, step=1,
                                   hint="2: single scattering; longer paths are rendered when nothing moves")
            aov = gui.add_dropdown("shown", (LIGHT, *AOVS), initial_value=LIGHT)
            stops = gui.add_slider("exposure", -6.0, 6.0, 0.1, 0.0, hint="stops")
            second = gui.add_dropdown("compared with", (NOTHING, *names()), initial_value=NOTHING)
            split = gui.add_slider("split", 0.0, 1.0, 0.01, 0.5)
            error = gui.add_button("Error against raymarch")
        self._link(visibility, "visibility", lambda v: session.choose(visibility=v))
        self._link(depth, "depth", lambda v: session.choose(max_depth=int(v)))
        self._link(aov, "shown", lambda v: session.choose(aov="" if v == LIGHT else v))
        self._link(second, "second", lambda v: session.choose(second_visibility="" if v == NOTHING else v))
        self._link(stops, "stops", lambda v: setattr(viewer, "stops", v), "shown")
        self._link(split, "split", lambda v: setattr(viewer, "split", v), "shown")

        error.on_click(self._on_error_button)

    def _link(self, handle: viser.GuiInputHandle[T], name: str, do: Callable[[T], object], kind: str = "other") -> None:
        """Call `do` with the value of a control after each change by a browser."""

        def update(event: viser.GuiEvent[viser.GuiInputHandle[T]]) -> None:
            if event.client is not None:  # None where this program set the value
                value = handle.value
                self.viewer.change(name, lambda: do(value), kind)

        handle.on_update(update)

    async def _on_error_button(self, _event: viser.GuiEvent[viser.GuiButtonHandle] | None) -> None:
        self._tell("Measuring the error against raymarch …")
        self.viewer.change("error", self._measure, "shown")

    def _measure(self) -> None:
        try:
            errors = ", ".join(f"{name} {100 * error:.2f} %" for name, error in self.session.error())
        except Interrupted:
            self._tell("The error was not measured, because something moved meanwhile.")
        else:
            self._tell(f"Error against raymarch: {errors}")

    def _add_light_folder(self, light: Light) -> None:
        gui, name = self.server.gui, f"{light.number} {light.kind}"
        if light.can_move or light.can_point:
            self._add_gizmo(light, name)
        if not (light.can_move or light.can_turn or light.can_dim):
            return
        with gui.add_folder(name):
            if light.can_move:
                position = gui.add_vector3("position", triple(np.round(light.position, 6)), step=0.01)
                self._link(position, f"light {name}", lambda v: self._type_position(light, name, v), "light")
                self.gizmos[name].position = position
            if light.can_turn:
                turn = gui.add_slider("rotation", -180.0, 180.0, 1.0, 0.0, hint="degrees about the camera's up axis")
                self._link(turn, f"turn {name}", light.turn, "light")
            if light.can_dim:
                dim = gui.add_slider("brightness", -4.0, 4.0, 0.1, 0.0, hint="stops")
                self._link(dim, f"dim {name}", lambda v: light.dim(2.0**v), "light")

    def _add_gizmo(self, light: Light, name: str) -> None:
        """Add handles at a light, or beside the fields for a directional light."""
        radius = max(m.frame.length for m in self.session.media)
        position = light.position if light.can_move else self.session.center - 1.5 * radius * light.direction
        wxyz = transforms.SO3.from_matrix(light.placement[:3, :3]).wxyz if light.can_point else (1, 0, 0, 0)
        handles = self.server.scene.add_transform_controls(
            f"/lights/{name}", scale=0.35 * radius, depth_test=False, disable_rotations=not light.can_point,
            disable_axes=not light.can_move, disable_sliders=not light.can_move, position=tuple(position), wxyz=wxyz)
        gizmo = self.gizmos[name] = Gizmo(handles)

        async def follow(_event: viser.TransformControlsEvent) -> None:
            position, wxyz = np.array(handles.position), np.array(handles.wxyz)
            self.viewer.change(f"light {name}", lambda: self._drag(light, gizmo, position, wxyz), "light")

        handles.on_update(follow)

    def _drag(self, light: Light, gizmo: Gizmo, position: np.ndarray, wxyz: np.ndarray) -> None:
        if light.can_move:
            light.move(position)
            if gizmo.position is not None:
                gizmo.position.value = triple(np.round(position, 6))  # type: ignore[misc]  # read-only in the stub
        if light.can_point:
            light.point(transforms.SO3(wxyz).as_matrix()[:, 2])

    def _type_position(self, light: Light, name: str, position: tuple[float, float, float]) -> None:
        light.move(position)
        self.gizmos[name].handles.position = position

    def _add_environments(self) -> None:
        """Add a choice of files for the environment, those beside its present one."""
        session = self.session
        if not any(light.can_turn for light in session.lights):
            return
        pictures = {path.name: path for path in reversed(environments.beside(session))}
        with self.server.gui.add_folder("Environment"):
            choice = self.server.gui.add_dropdown("file", tuple(reversed(pictures)) or (NOTHING,))
            button = self.server.gui.add_button("Open")

        def do() -> None:
            if choice.value in pictures:
                environments.swap_environment(session, pictures[choice.value])

        button.on_click(lambda _: self.viewer.change("environment", do, "light"))

    def _add_file_folder(self) -> None:
        gui, path = self.server.gui, self.session.path
        with gui.add_folder("File"):
            name = gui.add_text("name", f"{path.stem}_view.xml", hint="of a file beside the scene")
            camera = gui.add_checkbox("this camera", False, hint="save the camera of this window, not the scene's")
            button = gui.add_button("Save XML")
        button.on_click(lambda _: self.viewer.change("save", lambda: self._save(name.value, camera.value), "shown"))

    def _save(self, name: str, camera: bool) -> None:
        out = beside_scene(self.session, name)
        if out.exists() and out not in self._saved:
            raise MiNtfError(f"{out} exists, and this view did not write it; choose another name")
        save(self.session, out, camera=camera)
        self._saved.add(out)
        self._tell(f"Saved {out}")

    def _return_to_scene(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        if event.client is not None:
            view, pose = event.client.camera, self.session.initial_pose
            with event.client.atomic():
                view.up_direction, view.position, view.look_at = pose.up, pose.origin, pose.target

    def _step_back(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        """Move the camera away from the fields until all lights with a position are in view."""
        if event.client is None:
            return
        view, center = event.client.camera, self.session.center
        positions = [light.position for light in self.session.lights if light.can_move]
        if not positions:
            return
        reach = max(float(np.linalg.norm(p - center)) for p in positions)
        back = np.array(view.position, np.float64) - center
        back *= (0.5 * reach + reach / np.tan(min(float(view.fov), 2.0) / 2)) / max(float(np.linalg.norm(back)), 1e-9)
        view.position, view.look_at = tuple(center + back), tuple(center)
