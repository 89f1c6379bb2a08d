"""From a recording (video and logs) to a capture.

recording.py says what there is; video.py, logs.py, lens.py and border.py read it; interpolate.py gives poses and
joint values at the frames' times; select.py, sfm.py and registration.py find the cameras; pipeline.py does it all.
"""
