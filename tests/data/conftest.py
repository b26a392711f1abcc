from tests.helpers.recordings import ball_data, cube_data, cube_meshes, presets

__all__ = ["ball_data", "cube_data", "cube_meshes", "presets"]
