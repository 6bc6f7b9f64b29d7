"""A stand-in for PhysX's GPU simulation, for machines without it: ManiSkill's own code for `physx_cuda`, masks of
partial resets and all, on one CPU simulation an environment.

ManiSkill reads and writes a batch of environments through tensors that SAPIEN's `PhysxGpuSystem` holds on the GPU, and
calls `gpu_apply_*` and `gpu_fetch_*` to move them in and out of the simulation. `BatchedPhysx` has the same interface
over CPU tensors, and real physics behind it. Not had: rendering, external forces.
"""

import contextlib
from functools import cached_property
from types import SimpleNamespace
from unittest import mock

import torch

import ppo  # noqa: F401  before mani_skill, which it prepares for machines without Vulkan

# isort: split
import sapien
from mani_skill.envs import sapien_env
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.envs.utils.system.backend import BackendInfo
from mani_skill.utils import sapien_utils
from mani_skill.utils.structs import Articulation, ArticulationJoint
from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct
from sapien import physx


class Buffer:
    """What SAPIEN's CudaArray is to ManiSkill: something with .torch()"""

    def __init__(self, *shape):
        self.data = torch.zeros(shape)

    def torch(self):
        return self.data


def to_pose(row):
    return sapien.Pose(row[:3].numpy(), row[3:7].numpy())


class BatchedPhysx:
    """One PhysxCpuSystem an environment behind the interface of a PhysxGpuSystem.

    `cuda_rigid_body_data` is (bodies, 13): position, quaternion, linear and angular velocity; `cuda_articulation_*` are
    (articulations, most degrees of freedom)."""

    def __init__(self, scenes):
        self.systems = [scene.physx_system for scene in scenes]

    @property
    def timestep(self):
        return self.systems[0].timestep

    @timestep.setter
    def timestep(self, value):
        for system in self.systems:
            system.timestep = value

    def get_scene_offset(self, scene):
        return [0.0, 0.0, 0.0]

    def gpu_init(self):
        links = [link for system in self.systems for link in system.articulation_link_components]
        free = [body for system in self.systems for body in system.rigid_dynamic_components]
        self.bodies, self.num_free = free + links, len(free)
        self.articulations = [link.articulation for link in links if link.is_root]
        self.body_index = {body: i for i, body in enumerate(self.bodies)}
        self.articulation_index = {articulation: i for i, articulation in enumerate(self.articulations)}
        self.cuda_rigid_body_data = Buffer(len(self.bodies), 13)
        self.cuda_rigid_body_data.data[:, 3] = 1
        most = max([a.dof for a in self.articulations], default=0)
        for name in ("qpos", "qvel", "qacc", "qf", "target_qpos", "target_qvel"):
            setattr(self, f"cuda_articulation_{name}", Buffer(len(self.articulations), most))
        self.known = {k.removeprefix("cuda_"): v.data.clone() for k, v in vars(self).items() if k.startswith("cuda_")}
        self.gpu_fetch_all()

    def step(self):
        # ManiSkill leaves this to be done here: it asks for it only where the device is a GPU
        self.gpu_apply_articulation_target_position()
        self.gpu_apply_articulation_target_velocity()
        for system in self.systems:
            system.step()

    # --- contacts ---

    def gpu_create_contact_pair_impulse_query(self, pairs):
        return SimpleNamespace(pairs=[[body.entity for body in pair] for pair in pairs], cuda_impulses=None)

    def gpu_query_contact_pair_impulses(self, query):
        contacts = [contact for system in self.systems for contact in system.get_contacts()]
        query.cuda_impulses = Buffer(len(query.pairs), 3)
        for pair, row in zip(query.pairs, query.cuda_impulses.data):
            row[:] = torch.tensor(sapien_utils.get_pairwise_contact_impulse(contacts, *pair))

    def gpu_create_contact_body_impulse_query(self, bodies):
        return SimpleNamespace(entities=[body.entity for body in bodies], cuda_impulses=None)

    def gpu_query_contact_body_impulses(self, query):
        contacts = [contact for system in self.systems for contact in system.get_contacts()]
        query.cuda_impulses = Buffer(len(query.entities), 3)
        for entity, row in zip(query.entities, query.cuda_impulses.data):
            involved = sapien_utils.get_cpu_actor_contacts(contacts, entity)
            row[:] = torch.tensor(sapien_utils.compute_total_impulse(involved))

    # --- tensors to simulation ---

    def _written(self, name):
        """Rows of a tensor that were written since they were last read or applied. Others are left alone: setting what
        a simulation has already would change its last bits."""
        data, known = getattr(self, f"cuda_{name}").data, self.known[name]
        rows = (data != known).any(dim=1).nonzero().flatten().tolist()
        known.copy_(data)
        return [(i, data[i]) for i in rows]

    def gpu_apply_rigid_dynamic_data(self):
        links = []
        for i, row in self._written("rigid_body_data"):
            body = self.bodies[i]
            if i >= self.num_free:
                links.append((i, row))
                continue
            body.pose = to_pose(row)
            if not body.kinematic:
                body.linear_velocity, body.angular_velocity = row[7:10].numpy(), row[10:13].numpy()
        self.written_links = links  # for the two that ManiSkill calls next

    def gpu_apply_articulation_root_pose(self):
        for i, row in self.written_links:
            if self.bodies[i].is_root:
                self.bodies[i].articulation.root_pose = to_pose(row)

    def gpu_apply_articulation_root_velocity(self):
        for i, row in self.written_links:
            if self.bodies[i].is_root:
                root = self.bodies[i].articulation
                root.root_linear_velocity, root.root_angular_velocity = row[7:10].numpy(), row[10:13].numpy()

    def _apply(self, name):
        for i, row in self._written(f"articulation_{name}"):
            a = self.articulations[i]
            setattr(a, name, row[: a.dof].numpy())

    def gpu_apply_articulation_qpos(self):
        self._apply("qpos")

    def gpu_apply_articulation_qvel(self):
        self._apply("qvel")

    def gpu_apply_articulation_qf(self):
        self._apply("qf")

    def gpu_apply_articulation_target_position(self):
        for i, row in self._written("articulation_target_qpos"):
            for joint, target in zip(self.articulations[i].active_joints, row.tolist()):
                joint.set_drive_target(target)

    def gpu_apply_articulation_target_velocity(self):
        for i, row in self._written("articulation_target_qvel"):
            for joint, target in zip(self.articulations[i].active_joints, row.tolist()):
                joint.set_drive_velocity_target(target)

    # --- simulation to tensors ---

    def gpu_fetch_all(self):
        for body, row in zip(self.bodies, self.cuda_rigid_body_data.data):
            row[:3], row[3:7] = torch.tensor(body.pose.p), torch.tensor(body.pose.q)
            row[7:10], row[10:13] = torch.tensor(body.linear_velocity), torch.tensor(body.angular_velocity)
        for name in ("qpos", "qvel", "qacc", "qf"):
            for a, row in zip(self.articulations, getattr(self, f"cuda_articulation_{name}").data):
                row[: a.dof] = torch.tensor(getattr(a, name))
        for name, known in self.known.items():
            if "target" not in name:
                known.copy_(getattr(self, f"cuda_{name}").data)

    gpu_fetch_rigid_dynamic_data = gpu_fetch_all  # ManiSkill fetches everything at once

    def nothing(self):
        pass

    gpu_fetch_articulation_link_pose = gpu_fetch_articulation_link_velocity = nothing
    gpu_fetch_articulation_qpos = gpu_fetch_articulation_qvel = gpu_fetch_articulation_qacc = nothing
    gpu_fetch_articulation_target_qpos = gpu_fetch_articulation_target_qvel = nothing
    gpu_update_articulation_kinematics = nothing  # a CPU simulation's are up to date


def setup_scene(env):
    """BaseEnv._setup_scene, with as many CPU scenes as there are environments."""
    env._set_scene_config()
    scenes = [sapien.Scene([physx.PhysxCpuSystem()]) for _ in range(env.num_envs)]
    env.scene = ManiSkillScene(scenes, sim_config=env.sim_config, device=env.device, backend=env.backend)
    env.scene.px, env.scene.gpu_sim_enabled = BatchedPhysx(scenes), True
    env.scene.px.timestep = 1 / env._sim_freq


def index_in(cls, name, of, table):
    """ManiSkill asks each body for its row in the tensors; those of a CPU simulation know none."""

    def find(struct):
        rows = getattr(struct.scene.px, table)
        return torch.tensor([rows[x] for x in getattr(struct, of)], dtype=torch.int32)

    found = cached_property(find)
    found.__set_name__(cls, name)
    return mock.patch.object(cls, name, found)


@contextlib.contextmanager
def batched_physx():
    """Within it, gym.make(task, num_envs=N, sim_backend="physx_cuda") builds N environments on the stand-in."""
    backend = BackendInfo(torch.device("cpu"), sapien.Device("cpu"), "physx_cuda", None, "none")
    original, setup = sapien_env.parse_sim_and_render_backend, sapien_env.BaseEnv._setup_scene
    parse = lambda sim, render: backend if sim == "physx_cuda" else original(sim, render)
    setup_either = lambda env: (setup_scene if env.backend is backend else setup)(env)
    with (
        mock.patch.object(physx, "PhysxGpuSystem", BatchedPhysx),  # whose instances ManiSkill asks for
        mock.patch.object(sapien_env, "parse_sim_and_render_backend", parse),
        mock.patch.object(sapien_env.BaseEnv, "_setup_scene", setup_either),
        index_in(PhysxRigidBodyComponentStruct, "_body_data_index", "_bodies", "body_index"),
        index_in(Articulation, "_data_index", "_objs", "articulation_index"),
        index_in(ArticulationJoint, "_data_index", "_physx_articulations", "articulation_index"),
    ):
        yield
