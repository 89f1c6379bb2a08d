"""Calibration files of one camera or a stereo pair."""
