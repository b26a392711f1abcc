"""Gymnasium environments: `import sdfsim.envs` registers `sdfsim/Push-v0`, `sdfsim/Grasp-v0` and `sdfsim/Drop-v0`."""

import gymnasium

from sdfsim.envs.task import Task as Task
from sdfsim.envs.tasks import Drop as Drop
from sdfsim.envs.tasks import Grasp as Grasp
from sdfsim.envs.tasks import Push as Push

for _task in (Push, Grasp, Drop):
    gymnasium.register(f"sdfsim/{_task.__name__}-v0", entry_point=_task.single, vector_entry_point=_task)
