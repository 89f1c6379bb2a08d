"""The frames of a recording that are kept: chosen, written as images, and looked at with their cameras."""
