"""Settings of labels. Imports nothing heavy, as the settings of data sets, which take a default from here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class LabelSettings:
    """Thresholds of pixel labels, and limits of image labels."""

    # The instrument's moving shadow is learned with labels of 0.3 to 0.5, so that 0.5 is too low; 0.65 to 0.7 is best.
    threshold: float = 0.65
    # where the scene models that shadow: 0.65 then loses as much of the silhouette's border
    shadowed_threshold: float = 0.55
    # A share below the first is clearly tissue, one above the second clearly instrument. Measured by what a U-Net
    # learns from the rest: a band from 0.15 leaves out mostly tissue, so that it over-segments (IoU 0.93, not 0.96).
    clear_shares: tuple[float, float] = (0.5, 0.9)
    min_brightness: float = 0.1  # RGB norm above which a pixel of the instrument rendered alone is the instrument
    n_threshold_states: int = 24  # recorded states for Otsu's method
    max_unobserved: float = 0.5  # of a pixel, above which it is ignored
    surface_alpha: float = 0.5  # a pixel less opaque than this shows no surface
    # Of the image's diagonal: 3 px of 320 x 256. Without it, on two rendered captures, the band has 36% and 66% more
    # pixels, nearly all of them rightly labelled (the instrument's shadow on the tissue, mostly).
    edge_width: float = 0.008
    magnification: int = 4  # factor by which masks are enlarged for contours along pixel edges
    occlusion_mm: float = 1.0  # another surface this much nearer than a keypoint occludes it
    self_occlusion_mm: float = 6.0  # the same for the instrument's own surface, as keypoints lie inside it
    simplify_px: float = 0.8  # tolerance of polygons: below, a straight line's pixels would remain corners
    max_area_change: float = 0.02  # maximum relative change of area by simplification
    min_component: float = 0.01  # minimum share of an instrument's largest component for a component to be labelled


LABELS = LabelSettings()
