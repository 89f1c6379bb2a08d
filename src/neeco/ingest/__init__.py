"""From a recording (video and logs) to a capture.

recording.py says what there is; video.py, lens.py and logs.py read it (formats/: one module per log format);
interpolate.py gives poses and joint values at any time; frame_selection.py, sfm.py, motion.py and registration.py find
the cameras; synchronized.py brings the logs onto the video's clock; pipeline.py does it all.
"""
