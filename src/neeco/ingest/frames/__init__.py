"""The frames of a recording that are kept: chosen, written as images, and analysed with their cameras."""
