"""A Blender add-on (4.2 and later): File > Import > sdfsim run opens the folder of a run, each body as an object with
its name, its texture, and its motion as keys at the frame rate of the scene.

Install it: Edit > Preferences > Add-ons > Install from Disk, this file. sdfsim itself stays outside of Blender: if it
is not on the path, give the program in the add-on's preferences, such as /home/me/sdfsim/.venv/bin/sdfsim.
"""

import shutil
import subprocess
import tempfile
from pathlib import Path

import bpy
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ImportHelper

bl_info = {
    "name": "sdfsim runs",
    "author": "The sdfsim authors",
    "version": (0, 2, 0),
    "blender": (4, 2, 0),
    "location": "File > Import > sdfsim run",
    "description": "Opens runs of sdfsim: names, textures and motion",
    "category": "Import-Export",
}


class Preferences(bpy.types.AddonPreferences):
    bl_idname = __name__
    program: StringProperty(name="Program sdfsim", subtype="FILE_PATH", description="Empty: the one on the path")

    def draw(self, context):
        self.layout.prop(self, "program")


class ImportRun(bpy.types.Operator, ImportHelper):
    """Open a run of sdfsim: the rollout.npz in its folder"""

    bl_idname = "import_scene.sdfsim"
    bl_label = "Import sdfsim run"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012
    filename_ext = ".npz"
    filter_glob: StringProperty(default="*.npz", options={"HIDDEN"})
    allow_outside: BoolProperty(name="Files elsewhere", description="Meshes may lie outside of the scene's folder")

    def execute(self, context):
        scene = context.scene
        whole, base = scene.render.fps, scene.render.fps_base
        given = context.preferences.addons[__name__].preferences.program
        program = bpy.path.abspath(given) or shutil.which("sdfsim")
        if not program:
            self.report({"ERROR"}, "sdfsim is not on the path: give the program in the add-on's preferences")
            return {"CANCELLED"}
        before = set(bpy.data.actions)
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "run.glb"
            command = [program, "export", self.filepath, "-o", file, "--fps", repr(whole / base)]
            command += ["--allow-outside"] * self.allow_outside
            try:
                done = subprocess.run(command, capture_output=True, text=True)
            except OSError as error:
                self.report({"ERROR"}, f"{program} does not start: {error}")
                return {"CANCELLED"}
            if done.returncode:
                self.report({"ERROR"}, done.stderr.strip()[-500:])
                return {"CANCELLED"}
            scene.render.fps_base = 1.0 / base  # Blender's importer multiplies by the base of the rate
            bpy.ops.import_scene.gltf(filepath=str(file))
            scene.render.fps_base = base
        ends = [action.frame_range[1] for action in set(bpy.data.actions) - before]
        scene.frame_start, scene.frame_end = 0, round(max(ends, default=0))
        scene.frame_set(0)
        return {"FINISHED"}


def menu(self, context):
    self.layout.operator(ImportRun.bl_idname, text="sdfsim run (.npz)")


def register():
    for one in (Preferences, ImportRun):
        bpy.utils.register_class(one)
    bpy.types.TOPBAR_MT_file_import.append(menu)


def unregister():
    bpy.types.TOPBAR_MT_file_import.remove(menu)
    for one in (ImportRun, Preferences):
        bpy.utils.unregister_class(one)
