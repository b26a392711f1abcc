"""A tour in cells, to run as a whole or, in an editor that supports `# %%`, cell by cell: python samples/tour.py

It writes pictures and files to the folder `tour`.
"""

# %% A scene: bodies that fall into each other
from pathlib import Path

import numpy as np

import sdfsim

SHAPES = Path(__file__).resolve().parent / "shapes"
out = Path("tour")
out.mkdir(exist_ok=True)

scene = sdfsim.Scene(duration=1.5)
scene.add("floor", plane={}, friction=0.6)
scene.add("bowl", asset=str(SHAPES / "bowl"), scale=0.5, position=(0, 0, 0.15), mass=0.5, restitution=0.2)
scene.add("ring", asset=str(SHAPES / "ring"), scale=0.3, position=(0.02, 0, 0.3), mass=0.1, restitution=0.2)
scene.add("balls", sphere={"radius": 0.02}, count=8, arrange={"grid": [2, 2, 2], "spacing": 0.06}, position=(0, 0, 0.5),
          mass=0.03, restitution=0.4)  # fmt: skip
print(scene)

# %% Its motion: arrays in metres, kilograms and seconds
simulator = sdfsim.Simulator(scene)
rollout = simulator.run(on_progress=lambda share, line: print(f"{share:4.0%} {line}"))
print(rollout.names, rollout.position.shape)
camera = {"camera": (0.0, -1.3, 0.7), "look_at": (0, 0, 0.12)}
for at in (0.0, 0.25, 1.5):
    sdfsim.render(scene, rollout, out / f"tour-{at:g}.png", at=min(at, rollout.time[-1]), **camera)

# %% By hand: pull the bowl, and list the bodies that touch it
bowl = simulator["bowl"]
bowl.pull((6.0, 0.0, 0.0))  # N
simulator.step(60)
touching = {contact.first for contact in simulator.contact_points() if contact.second == "bowl"}
print(f"the bowl moves at {bowl.velocity[0]:.2f} m/s; it is touched by {sorted(touching)}")

# %% Variants: the same with different frictions, on all cores
frictions = np.linspace(0.1, 0.9, 5)
found = simulator.rollouts([{"bowl": {"friction": mu, "velocity": (1.0, 0.0, 0.0)}} for mu in frictions], seconds=0.5)
for mu, run in zip(frictions, found, strict=True):
    print(f"friction {mu:.1f}: slid {run.position[-1, 1, 0]:.3f} m")

# %% On to other programs
scene.save(out / "tour.yaml")
rollout.save(out / "tour.npz")
report = sdfsim.export(out / "tour.npz", out / "tour.glb", scene_file=out / "tour.yaml", fps=24, allow_outside=True)
print(report["files"])
