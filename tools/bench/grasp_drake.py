"""Grasp by Drake's contact: spheres on two prismatic joints each, moved by position servos.

Its hydroelastic contact has a pressure over a patch, and friction of the patch gives torsion; its point contact has no
torsion. Both are as stiff as the fingertips here, with Drake's default settings.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final

import numpy as np

from softfinger.tools.bench import grasp_case as case
from softfinger.tools.bench.grasp_case import Held, Peer
from softfinger.tools.measure import Array

RAIL_KG: Final = 0.001
SERVO_N_PER_M: Final = 1e5
"""A hundred times the contact's stiffness: it yields by 0.03 mm under the grip."""
SERVO_NS_PER_M: Final = 100.0
MODULUS_PA: Final = 1.36e5
"""Hydroelastic modulus of the spheres: at a depth of 3 mm it gives 3 N, like 1000 N/m."""
RESOLUTION_M: Final = 0.002
"""Resolution of Drake's mesh of a sphere."""
CONTACTS: Final = {"Drake, point contact": "point", "Drake, hydroelastic": "hydroelastic"}


def drake(module: str) -> Any:
    """Return a module of pydrake; raises ConfigError if it is not installed."""
    return case.peer_module("drake", f"pydrake.{module}", "drake")


def imported() -> Any:
    """Return Drake's plants; raises ConfigError if it is not installed."""
    return drake("multibody.plant")


class Drake(Peer):
    """Drake with one of CONTACTS."""

    def __init__(self, contact: str) -> None:
        self._tree, self._math, self._geometry = (drake(name) for name in ("multibody.tree", "math", "geometry"))
        plants, builder = imported(), drake("systems.framework").DiagramBuilder()
        config = plants.MultibodyPlantConfig(time_step=case.DT, contact_model=contact)
        self._plant, self._scene = plants.AddMultibodyPlant(config, builder)
        self._friction: Final = plants.CoulombFriction(case.FRICTION, case.FRICTION)
        self._hydroelastic: Final = contact == "hydroelastic"
        self._add_box()
        self._fingers = {name: self._add_finger(name) for name in case.SIDES}
        self._plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self._plant.Finalize()
        diagram = builder.Build()
        root = diagram.CreateDefaultContext()
        self._context: Final = self._plant.GetMyMutableContextFromRoot(root)
        for name, side in case.SIDES.items():
            self._plant.SetPositions(self._context, self._fingers[name], [case.x_of(side, -case.APART_M), 0.0])
        self._pushed([])
        self.lead(-case.APART_M, 0.0)
        self._simulator, self._ticks = drake("systems.analysis").Simulator(diagram, root), 0

    def _add_box(self) -> None:
        size = (2.0 * case.HALF_M,) * 3
        self._box = self._plant.AddRigidBody("box", self._tree.SpatialInertia.SolidBoxWithMass(case.MASS_KG, *size))
        self._register(self._box, self._geometry.Box(*size))

    def _add_finger(self, name: str) -> Any:
        """Add a weightless sphere that one servo moves along x and one along z."""
        instance, tree = self._plant.AddModelInstance(name), self._tree
        inertia = tree.SpatialInertia.SolidSphereWithMass
        rail = self._plant.AddRigidBody(f"{name}-rail", instance, inertia(RAIL_KG, case.RADIUS_M))
        finger = self._plant.AddRigidBody(name, instance, inertia(case.FINGER_KG, case.RADIUS_M))
        place = self._math.RigidTransform([0.0, case.BESIDE_M, 0.0])
        base = self._plant.AddFrame(tree.FixedOffsetFrame(f"{name}-base", self._plant.world_frame(), place))
        for axis, parent, child in (
            ((1.0, 0.0, 0.0), base, rail.body_frame()),
            ((0.0, 0.0, 1.0), rail.body_frame(), finger.body_frame()),
        ):
            joint = self._plant.AddJoint(tree.PrismaticJoint(f"{name}-{child.name()}", parent, child, axis))
            servo = self._plant.AddJointActuator(joint.name(), joint)
            servo.set_controller_gains(tree.PdControllerGains(p=SERVO_N_PER_M, d=SERVO_NS_PER_M))
        self._register(finger, self._geometry.Sphere(case.RADIUS_M))
        return instance

    def _register(self, body: Any, shape: Any) -> None:
        """Register a body's shape with its contact properties.

        Two bodies in series each get twice the stiffness.
        """
        properties, geometry = self._geometry.ProximityProperties(), self._geometry
        stiffness = {} if self._hydroelastic else {"point_stiffness": 2.0 * case.STIFFNESS}
        geometry.AddContactMaterial(friction=self._friction, properties=properties, **stiffness)
        if self._hydroelastic and body is self._box:
            geometry.AddRigidHydroelasticProperties(case.HALF_M, properties)
        elif self._hydroelastic:
            geometry.AddCompliantHydroelasticProperties(RESOLUTION_M, MODULUS_PA, properties)
        self._plant.RegisterCollisionGeometry(
            body, self._math.RigidTransform(), shape, f"{body.name()}-shape", properties
        )

    def _pushed(self, forces: list[Any]) -> None:
        self._plant.get_applied_spatial_force_input_port().FixValue(self._context, forces)

    def lead(self, depth: float, height: float) -> None:
        for name, side in case.SIDES.items():
            port = self._plant.get_desired_state_input_port(self._fingers[name])
            port.FixValue(self._context, [case.x_of(side, depth), height, 0.0, 0.0])

    def weigh(self) -> None:
        weight = imported().ExternallyAppliedSpatialForce()
        weight.body_index = self._box.index()
        weight.p_BoBq_B = np.zeros(3)
        weight.F_Bq_W = drake("multibody.math").SpatialForce(
            np.zeros(3), np.array([0.0, 0.0, -case.MASS_KG * case.GRAVITY])
        )
        self._pushed([weight])

    def step(self) -> None:
        self._ticks += 1
        self._simulator.AdvanceTo(self._ticks * case.DT)

    def box(self) -> Array:
        pose = self._plant.EvalBodyPoseInWorld(self._context, self._box)
        return np.array([*pose.translation(), *pose.rotation().ToQuaternion().wxyz()])

    def force(self) -> Array:
        found, total = self._plant.get_contact_results_output_port().Eval(self._context), np.zeros(3)
        for number in range(found.num_point_pair_contacts()):
            each = found.point_pair_contact_info(number)
            names = [self._plant.get_body(index).name() for index in (each.bodyA_index(), each.bodyB_index())]
            if "thumb" in names:  # the force on B
                total += each.contact_force() if names[1] == "thumb" else -each.contact_force()
        inspector = self._scene.model_inspector()
        for number in range(found.num_hydroelastic_contacts()):
            patch = found.hydroelastic_contact_info(number)
            frames = [
                inspector.GetFrameId(shape)
                for shape in (patch.contact_surface().id_M(), patch.contact_surface().id_N())
            ]
            names = [self._plant.GetBodyFromFrameId(frame).name() for frame in frames]
            if "thumb" in names:  # the force on A, which has M
                force = patch.F_Ac_W().translational()
                total += force if names[0] == "thumb" else -force
        return total


def contacts(seconds: float) -> Iterator[tuple[str, Held]]:
    """Yield each of CONTACTS with its grasp."""
    for name, contact in CONTACTS.items():
        yield name, case.hold(Drake(contact), case.GRIP_N / case.STIFFNESS, seconds)
