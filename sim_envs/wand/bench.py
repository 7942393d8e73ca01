"""The wand's bench as a MuJoCo scene: green screen, object, wand and four cameras.

World frame: z up, the bench's top at z = 0, the object near the origin. Nothing falls or slides
here: the wand goes where it is put, and its force is prescribed.
"""

import mujoco
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from touchgoal.sim_envs.scene.build import (
    HIDDEN_GROUP,
    NO_CONTACT,
    OBJECT_GROUP,
    VISUAL_GROUP,
    geom_type,
    look_at,
    quaternion,
)
from touchgoal.sim_envs.scene.objects import HARD, Body, Material, ObjectKind, Texture
from touchgoal.sim_envs.wand.objects import Mesh, Part, WandObject

VIEWS = ("top", "side_left", "side_right", "wand")
"""Cameras: overhead, from both sides, and the point of view on the wand."""
GREEN = (0.05, 0.62, 0.2)  # of the green screen
_BENCH = "bench"
_SHADOW = 512  # px; with 1024, shadows take a third of a touch's time
_LOOK = {
    "plain": mujoco.mjtBuiltin.mjBUILTIN_FLAT,
    "speckled": mujoco.mjtBuiltin.mjBUILTIN_FLAT,
    "checker": mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
    "gradient": mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
}
_EYES = {
    "top": (0.0, 0.02, 0.62),
    "side_left": (-0.42, -0.42, 0.3),
    "side_right": (0.42, -0.42, 0.3),
}
_FOVY = 26
_MATERIAL = Material(Texture.SMOOTH, 0.0, 1e-3, HARD, 0.5, (*GREEN, 1.0))


class Bench:
    """One object on the bench, and the wand.

    Attributes:
        model, data: the compiled scene.
        bodies: what the gel can touch, the bench among them; `TactilePad` takes them.
        shown: geoms that cameras show.
    """

    def __init__(self, wand_object: WandObject, size: tuple[int, int]) -> None:
        """`size`: rows and columns of the views."""
        spec = mujoco.MjSpec()
        _set_visuals(spec, size)
        holder = spec.worldbody.add_body(name="object", mocap=True)
        self.bodies = [_bench_body(spec)]
        for i, part in enumerate(wand_object.parts):
            self.bodies.append(_add_part(spec, holder, f"part_{i}", part))
        _add_wand(spec)
        _add_screen(spec)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self._object = int(self.model.body("object").mocapid[0])
        self._wand = int(self.model.body("wand").mocapid[0])
        mujoco.mj_forward(self.model, self.data)
        parts = [g for g in range(self.model.ngeom) if self.model.geom_group[g] == OBJECT_GROUP]
        self._parts = [g for g in parts if self.model.geom(g).name != _BENCH]
        self.shown = mujoco.MjvOption()
        self.shown.geomgroup[OBJECT_GROUP] = 0
        self._centre, self.radius = _bounds(self.model, self.data, self._parts)

    @property
    def centre(self) -> Float[np.ndarray, "3"]:
        """Middle of the object, m, world frame."""
        turn = Rotation.from_quat(self.data.mocap_quat[self._object], scalar_first=True)
        return self.data.mocap_pos[self._object] + turn.as_matrix() @ self._centre

    def place_object(self, x: float, y: float, yaw: float) -> None:
        """Put the object on the bench, m and rad."""
        self.data.mocap_pos[self._object] = (x, y, 0)
        self.data.mocap_quat[self._object] = np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)
        mujoco.mj_kinematics(self.model, self.data)

    def place_wand(self, tip: Float[np.ndarray, "3"], axes: Float[np.ndarray, "3 3"]) -> None:
        """Put the gel's middle at `tip` (m); `axes` is the sensor frame, z out of the gel."""
        self.data.mocap_pos[self._wand] = tip
        self.data.mocap_quat[self._wand] = quaternion(axes)
        mujoco.mj_forward(self.model, self.data)

    def surface_along(
        self, start: Float[np.ndarray, "3"], direction: Float[np.ndarray, "3"]
    ) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None:
        """Return the object's first point along a ray and its outward normal; None if it is missed."""
        geom, normal = np.zeros((1, 1), np.int32), np.zeros((3, 1))
        groups = np.zeros((6, 1), np.uint8)
        groups[OBJECT_GROUP] = 1
        ray = start[:, None], direction[:, None]
        far = mujoco.mj_ray(self.model, self.data, *ray, groups, True, -1, geom, normal)
        if far < 0 or int(geom[0, 0]) not in self._parts:
            return None
        return start + far * direction, normal[:, 0]

    def geoms_near(self, point: Float[np.ndarray, "3"], radius: float) -> frozenset[int]:
        """Return the geoms, the bench's too, whose bounding spheres reach within `radius` of a point."""
        model, data = self.model, self.data
        near = [
            g
            for g in self._parts
            if np.linalg.norm(data.geom_xpos[g] - point) < model.geom_rbound[g] + radius
        ]
        return frozenset([*near, model.geom(_BENCH).id])


def _set_visuals(spec: mujoco.MjSpec, size: tuple[int, int]) -> None:
    spec.stat.extent, spec.stat.center = 0.3, np.array([0, 0, 0.05])
    visual = spec.visual
    visual.map.znear, visual.map.zfar = 0.02, 10.0
    visual.global_.offheight, visual.global_.offwidth = size
    visual.quality.shadowsize, visual.quality.offsamples, visual.quality.numslices = _SHADOW, 0, 40
    visual.headlight.ambient = visual.headlight.diffuse = np.full(3, 0.25, np.float32)
    visual.headlight.specular = np.zeros(3, np.float32)
    world = spec.worldbody
    world.add_light(
        name="key", pos=[0.4, -0.5, 0.85], dir=[-0.4, 0.5, -0.9], diffuse=[0.5] * 3, castshadow=True
    )
    world.add_light(
        pos=[-0.6, 0.3, 0.8], dir=[0.6, -0.3, -0.8], diffuse=[0.25] * 3, castshadow=False
    )


def _bench_body(spec: mujoco.MjSpec) -> Body:
    """Add the bench's top, which thin objects are pressed against."""
    body = Body(ObjectKind(_BENCH, "box", _MATERIAL, ()), (0.9, 0.9, 0.01), 1.0, _BENCH)
    item = spec.worldbody.add_body(name=_BENCH, pos=[0, 0, -0.01])
    for name, group in ((_BENCH, OBJECT_GROUP), ("", VISUAL_GROUP)):
        item.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=body.size,
            group=group,
            rgba=_MATERIAL.rgba,
            friction=[_MATERIAL.friction, 0.005, 0.0001],
            **NO_CONTACT,
        )
    return body


def _add_screen(spec: mujoco.MjSpec) -> None:
    """Add green walls and a green ceiling all around: no camera on the wand sees past them."""
    far, thin = 0.9, 0.01
    walls = [(sign * far * np.eye(3)[axis], axis) for axis in (0, 1) for sign in (-1, 1)]
    for place, axis in [*walls, (far * np.eye(3)[2], 2)]:
        size = np.full(3, far)
        size[axis] = thin
        spec.worldbody.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=size,
            pos=place,
            rgba=[*GREEN, 1],
            group=VISUAL_GROUP,
            **NO_CONTACT,
        )
    for name, eye in _EYES.items():
        up = (0, 1, 0) if name == "top" else (0, 0, 1)
        spec.worldbody.add_camera(
            name=name, pos=eye, quat=look_at(eye, (0, 0, 0.05), up), fovy=_FOVY
        )


def _add_part(spec: mujoco.MjSpec, holder: mujoco.MjsBody, name: str, part: Part) -> Body:
    """Add a part twice: as the gel feels it, and coarser as cameras see it."""
    item = holder.add_body(name=name, pos=part.position.tolist(), quat=quaternion(part.rotation))
    for group, mesh in ((OBJECT_GROUP, part.mesh), (VISUAL_GROUP, part.coarse)):
        shape: dict = (
            {"size": [*part.size, 0, 0][:3]} if mesh is None else {"meshname": _mesh(spec, mesh)}
        )
        item.add_geom(
            type=geom_type(part.shape),
            material=_paint(spec, part),
            group=group,
            friction=[part.material.friction, 0.005, 0.0001],
            **NO_CONTACT,
            **shape,
        )
    return Body(ObjectKind(name, "mesh", part.material, ()), part.size, 1.0, name)


def _mesh(spec: mujoco.MjSpec, mesh: Mesh) -> str:
    """Return the name of a mesh, added when it is new; the parts of a row share theirs."""
    name = f"mesh_{id(mesh)}"
    if not any(known.name == name for known in spec.meshes):
        vertices, faces = mesh
        spec.add_mesh(
            name=name,
            uservert=vertices.ravel().tolist(),
            userface=faces.ravel().tolist(),
            # a thin wall's volume is too small for MuJoCo
            inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL,
        )
    return name


def _paint(spec: mujoco.MjSpec, part: Part) -> str:
    """Return a material with the part's colours, made when it is new."""
    rgb, second = part.material.rgba[:3], part.second_rgb
    name = "_".join(f"{v:.3f}" for v in (*part.material.rgba, *second)) + part.look
    if any(material.name == name for material in spec.materials):
        return name
    marks = (
        {"mark": mujoco.mjtMark.mjMARK_RANDOM, "random": 0.25} if part.look == "speckled" else {}
    )
    spec.add_texture(
        name=name,
        type=mujoco.mjtTexture.mjTEXTURE_CUBE,
        builtin=_LOOK[part.look],
        rgb1=rgb,
        rgb2=second,
        markrgb=second,
        width=64,
        height=64,
        **marks,
    )
    material = spec.add_material(
        name=name, specular=0.3, shininess=0.4, rgba=[1, 1, 1, part.material.rgba[3]]
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    return name


def _add_wand(spec: mujoco.MjSpec) -> None:
    """Add the stick: sensor frame at its tip, z out of the gel, camera above the tip."""
    wand = spec.worldbody.add_body(name="wand", mocap=True, pos=[0, 0, 1])
    wand.add_site(name="left_sensor", group=HIDDEN_GROUP)
    dark, metal = [0.12, 0.12, 0.13, 1], [0.55, 0.57, 0.6, 1]
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    for kind, size, z, rgba in (
        (box, [0.0125, 0.0105, 0.002], -0.003, [0.75, 0.75, 0.78, 1]),  # gel
        (box, [0.016, 0.014, 0.013], -0.018, dark),  # case of the Mini
        (box, [0.02, 0.018, 0.006], -0.037, metal),  # load cell
        (cylinder, [0.013, 0.09, 0], -0.133, dark),  # handle
    ):
        wand.add_geom(
            type=kind,
            size=size,
            pos=[0, 0, z],
            rgba=rgba,
            group=VISUAL_GROUP,
            **NO_CONTACT,
        )
    eye = (-0.055, 0.0, -0.075)
    wand.add_camera(name="wand", pos=eye, quat=look_at(eye, (0, 0, 0.005), (0, 0, -1)), fovy=70)


def _bounds(
    model: mujoco.MjModel, data: mujoco.MjData, geoms: list[int]
) -> tuple[Float[np.ndarray, "3"], float]:
    """Return the middle of the parts and the radius of a sphere around it that holds them, m."""
    places, reach = data.geom_xpos[geoms], model.geom_rbound[geoms]
    low, high = (places - reach[:, None]).min(0), (places + reach[:, None]).max(0)
    centre = (low + high) / 2
    return centre, float((np.linalg.norm(places - centre, axis=1) + reach).max())
