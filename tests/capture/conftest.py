from capture_folders import folder, pristine

__all__ = ["folder", "pristine"]
