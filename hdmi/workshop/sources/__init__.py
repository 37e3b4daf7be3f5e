"""Readers of other people's motions: of persons into `HumanMotion`, of robots into `Motion` and back.

Files are data, never programs: nothing is unpickled (`plain_pickle` reads those of robot motions without running
them), damaged files end in a MotionError that names file, field and frame.
"""

from hdmi.workshop.sources.bvh import read_bvh
from hdmi.workshop.sources.conventions import Conventions
from hdmi.workshop.sources.formats import FORMATS, convert, guess_format
from hdmi.workshop.sources.interaction import read_intermimic, read_omomo
from hdmi.workshop.sources.person import PERSON_FORMATS, read_person
from hdmi.workshop.sources.robot import read_holosoma, read_mjlab, write_holosoma, write_mjlab
from hdmi.workshop.sources.robot_csv import read_robot_csv, write_robot_csv
from hdmi.workshop.sources.robot_pickle import read_robot_pickle
from hdmi.workshop.sources.smpl import read_amass, read_gvhmr

__all__ = [
    "FORMATS",
    "PERSON_FORMATS",
    "Conventions",
    "convert",
    "guess_format",
    "read_amass",
    "read_bvh",
    "read_gvhmr",
    "read_holosoma",
    "read_intermimic",
    "read_mjlab",
    "read_omomo",
    "read_person",
    "read_robot_csv",
    "read_robot_pickle",
    "write_holosoma",
    "write_mjlab",
    "write_robot_csv",
]
