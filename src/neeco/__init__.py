"""neeco: labelled images of surgical instruments in states nobody recorded."""

__version__ = "0.1.0"
