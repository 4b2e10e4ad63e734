"""A view's controls in a browser (viser): nothing is fetched from, or shared with, another machine."""

from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from mi_ntf.infer.visibility import names
from mi_ntf.page_server import serve

from . import environments
from .camera import Pose, three
from .lights import Light
from .save import beside_scene, save
from .session import SEEN, Session
from .viewer import Viewer

LIGHT, NOTHING = "light", "–"
JPEG = 90


class Controls:
    """The page of `session` at `host`:`port`, or the next port that is free; ``url`` says where."""

    def __init__(self, session: Session, host: str = "127.0.0.1", port: int = 8080, samples: int = 64):
        self.session = session
        self.server, self.url = serve(f"mi-ntf: {session.path.name}", host, port)
        self.viewer = Viewer(session, self._show, self._tell, samples)
        self.gizmos: dict[int, Any] = {}
        self._camera()
        self._picture_folder()
        for light in session.lights:
            self._light_folder(light)
        self._environments()
        self._file_folder()

    def run(self) -> None:
        """Serve until :meth:`stop`, rendering in this thread."""
        self.viewer.change("opened", lambda: None)
        try:
            self.viewer.run()
        finally:
            self.server.stop()

    def stop(self) -> None:
        self.viewer.stop()

    def _show(self, picture: np.ndarray, status: str) -> None:
        self.server.scene.set_background_image(picture, format="jpeg", jpeg_quality=JPEG)
        self._status.content = status

    def _tell(self, text: str) -> None:
        self._answer.content = text

    def _camera(self) -> None:
        pose, first = self.session.pose, self.server.initial_camera
        self.server.scene.set_up_direction(pose.up)
        first.up, first.position, first.look_at = (np.array(v) for v in (pose.up, pose.origin, pose.target))
        first.fov = float(np.radians(pose.fov))

        @self.server.on_client_connect
        def _(client: viser.ClientHandle) -> None:
            client.camera.on_update(lambda _: self._looked(client.camera))

    def _looked(self, view: viser.CameraHandle) -> None:
        """The browser's camera is elsewhere, or its window has another shape."""
        turn = viser.transforms.SO3(np.array(view.wxyz)).as_matrix()
        position, aspect = np.array(view.position, np.float64), float(view.aspect)
        away = float(np.linalg.norm(np.array(view.look_at) - position))
        pose = Pose(three(position), three(position + away * turn[:, 2]), three(-turn[:, 1]),
                    float(np.degrees(view.fov)))

        def do() -> None:
            size = self.session.edge
            if abs(self.session.size[0] / self.session.size[1] - aspect) > 2 / size:
                self.session.resize(size, aspect)
            self.session.look(pose)

        self.viewer.change("camera", do, "camera")

    def _picture_folder(self) -> None:
        gui, viewer, session = self.server.gui, self.viewer, self.session
        self._status, self._answer = gui.add_markdown(""), gui.add_markdown("")
        with gui.add_folder("Picture"):
            visibility = gui.add_dropdown("visibility", tuple(names()), initial_value=session.settings.visibility)
            depth = gui.add_number("max_depth", session.settings.max_depth, min=-1, max=64, step=1,
                                   hint="2: light scatters once; more of it when the picture rests")
            shown = gui.add_dropdown("shown", (LIGHT, *SEEN), initial_value=LIGHT)
            stops = gui.add_slider("exposure", -6.0, 6.0, 0.1, 0.0, hint="stops")
            other = gui.add_dropdown("compared with", (NOTHING, *names()), initial_value=NOTHING)
            share = gui.add_slider("split", 0.0, 1.0, 0.01, 0.5)
            error = gui.add_button("Error against raymarch")
        self._link(visibility, "visibility", lambda v: session.choose(visibility=v))
        self._link(depth, "depth", lambda v: session.choose(max_depth=int(v)))
        self._link(shown, "shown", lambda v: session.choose(shown="" if v == LIGHT else v))
        self._link(other, "other", lambda v: session.choose(other="" if v == NOTHING else v))
        self._link(stops, "stops", lambda v: setattr(viewer, "stops", v), "shown")
        self._link(share, "share", lambda v: setattr(viewer, "share", v), "shown")
        error.on_click(lambda _: viewer.change("error", self._measure, "shown"))

    def _link(self, handle: Any, name: str, do: Callable[[Any], Any], kind: str = "other") -> None:
        """`do` with the value of a control whenever it has another."""

        def update(event) -> None:
            if event.client is not None:  # not where this program set it
                value = handle.value
                self.viewer.change(name, lambda: do(value), kind)

        handle.on_update(update)

    def _measure(self) -> None:
        found = ", ".join(f"{100 * e:.2f} %" for e in self.session.error())
        self._tell(f"Relative RMSE against raymarch: {found}")

    def _light_folder(self, light: Light) -> None:
        gui, name = self.server.gui, f"{light.number} {light.kind}"
        if light.can_move or light.can_point:
            self._gizmo(light, name)
        if not (light.can_move or light.can_turn or light.can_dim):
            return
        with gui.add_folder(name):
            if light.can_move:
                place = gui.add_vector3("position", three(np.round(light.position, 6)), step=0.01)
                self._link(place, f"light {name}", lambda v: self._typed(light, v), "light")
                self.gizmos[light.number].place = place
            if light.can_turn:
                turn = gui.add_slider("rotation", -180.0, 180.0, 1.0, 0.0, hint="degrees about the camera's up axis")
                self._link(turn, f"turn {name}", light.turn, "light")
            if light.can_dim:
                dim = gui.add_slider("brightness", -4.0, 4.0, 0.1, 0.0, hint="stops")
                self._link(dim, f"dim {name}", lambda v: light.dim(2.0**v), "light")

    def _gizmo(self, light: Light, name: str) -> None:
        """Handles at a light, or, of one from far away, beside the fields."""
        radius = max(m.frame.length for m in self.session.media)
        turns = light.can_point
        at = light.position if light.can_move else self.session.center - 1.5 * radius * light.direction
        controls = self.server.scene.add_transform_controls(
            f"/lights/{name}", scale=0.35 * radius, depth_test=False, disable_rotations=not turns,
            disable_axes=not light.can_move, disable_sliders=not light.can_move,
            position=tuple(at), wxyz=viser.transforms.SO3.from_matrix(light.placement[:3, :3]).wxyz if turns
            else (1, 0, 0, 0))
        self.gizmos[light.number] = _Gizmo(controls)

        @controls.on_update
        async def _(event) -> None:
            position, wxyz = np.array(controls.position), np.array(controls.wxyz)
            self.viewer.change(f"light {name}", lambda: self._dragged(light, position, wxyz), "light")

    def _dragged(self, light: Light, position: np.ndarray, wxyz: np.ndarray) -> None:
        if light.can_move:
            light.move(position)
            place = self.gizmos[light.number].place
            if place is not None:
                place.value = three(np.round(position, 6))
        if light.can_point:
            light.point(viser.transforms.SO3(wxyz).as_matrix()[:, 2])

    def _typed(self, light: Light, value) -> None:
        light.move(value)
        self.gizmos[light.number].controls.position = value

    def _environments(self) -> None:
        """A choice of files for the environment: those beside its own."""
        session = self.session
        if not any(light.can_turn for light in session.lights):
            return
        found = environments.beside(session)
        with self.server.gui.add_folder("Environment"):
            choice = self.server.gui.add_dropdown("file", tuple(p.name for p in found) or ("–",))
            button = self.server.gui.add_button("Open")

        def do() -> None:
            chosen = next((p for p in found if p.name == choice.value), None)
            if chosen is not None:
                environments.swap_environment(session, chosen)

        button.on_click(lambda _: self.viewer.change("environment", do, "light"))

    def _file_folder(self) -> None:
        gui, path = self.server.gui, self.session.path
        with gui.add_folder("File"):
            name = gui.add_text("name", f"{path.stem}_view.xml", hint="of a file beside the scene")
            button = gui.add_button("Save XML")
        gui.add_button("See all lights", hint="step back until they are in view").on_click(self._step_back)
        button.on_click(lambda _: self.viewer.change("save", lambda: self._save(name.value), "shown"))

    def _save(self, name: str) -> None:
        out = beside_scene(self.session, name)
        save(self.session, out)
        self._tell(f"Saved {out}")

    def _step_back(self, event) -> None:
        """Move the camera away from the fields until all lights that have a place are in view."""
        if event.client is None:
            return
        view, center = event.client.camera, self.session.center
        places = [light.position for light in self.session.lights if light.can_move]
        reach = max([float(np.linalg.norm(p - center)) for p in places], default=0.0)
        away = np.array(view.position, np.float64) - center
        away *= (0.5 * reach + reach / np.tan(min(float(view.fov), 2.0) / 2)) / max(float(np.linalg.norm(away)), 1e-9)
        view.position, view.look_at = tuple(center + away), tuple(center)


class _Gizmo:
    """The handles of a light, and the numbers that show its place, if there are any."""

    def __init__(self, controls: Any):
        self.controls, self.place = controls, None  # type: Any, Any
