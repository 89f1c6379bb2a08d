"""Captures: data model, readers, writer and checks."""

from neeco.capture.checks import check_capture as check_capture
from neeco.capture.documents import Problem as Problem
from neeco.capture.documents import errors_only as errors_only
from neeco.capture.kinematics import KinematicTree as KinematicTree
from neeco.capture.kinematics import Link as Link
from neeco.capture.model import Camera as Camera
from neeco.capture.model import Capture as Capture
from neeco.capture.model import Frame as Frame
from neeco.capture.model import Instrument as Instrument
from neeco.capture.model import InstrumentState as InstrumentState
from neeco.capture.model import PointCloud as PointCloud
from neeco.capture.model import State as State
from neeco.capture.model import Uncertainty as Uncertainty
from neeco.capture.model import evenly_spaced as evenly_spaced
from neeco.capture.readers import read_capture as read_capture
from neeco.capture.readers import read_dvrk_tool as read_dvrk_tool
from neeco.capture.readers import read_urdf as read_urdf
from neeco.capture.writer import fingerprint as fingerprint
from neeco.capture.writer import write_capture as write_capture
