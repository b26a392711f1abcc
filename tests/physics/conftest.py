from tests.helpers.scenes import box_shape, dropped, free_pair

__all__ = ["box_shape", "dropped", "free_pair"]
