from rod_world import camera, run, scene, state

__all__ = ["camera", "run", "scene", "state"]
