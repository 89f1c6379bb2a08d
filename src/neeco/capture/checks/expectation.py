"""Label quality to expect from a number of training frames, as measured on captures with exact states."""

from __future__ import annotations

# Training frames -> label IoU on seen and on unseen states, of the capture that looks most like a real recording; the
# commands are in notes/2026-11-26-results-quality.md, "Few frames".
LABEL_IOU = {10: (0.91, 0.82), 15: (0.94, 0.88), 60: (0.97, 0.93)}


def expected_labels(frames: int) -> str | None:
    """Return one line on what labels so many training frames gave, and a larger number; None where no more are needed.

    The numbers are those of the nearest measured count that is not larger, or of the smallest.
    """
    counts = sorted(LABEL_IOU)
    if not 0 < frames < counts[-1]:
        return None
    index = max(0, sum(count <= frames for count in counts) - 1)
    gave = [
        f"{count} training frames gave IoU {LABEL_IOU[count][0]:.2f} on seen and {LABEL_IOU[count][1]:.2f} on unseen "
        "states"
        for count in counts[index : index + 2]
    ]
    return f"labels to expect: with exact states, {', '.join(gave)}"
