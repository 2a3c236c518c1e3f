"""Map of the steel near a path: its figures, and its voxels in a recording."""

import numpy as np
import rerun as rr

from magfusion.estimation.integrity.steel_map import SteelMap
from magfusion.results.figures import Figure, Figures, Section

DRAWN_SIGMAS = 2.0  # sigma; a voxel less certain than this is drawn grey
MIN_DRAWN = 0.05  # of the largest polarisability; less is not drawn
_STEEL, _UNSURE = (235, 120, 60), (140, 140, 140)


def steel_figures(steel: SteelMap) -> Figures:
    """Return how well the map of some beacons predicts the fields of another."""
    return Figures(
        Figure("steel_map_used", steel.is_used, section=Section.REPORT),
        Figure("steel_map_error_ratio", steel.ratio, section=Section.REPORT),
        Figure("steel_distortion_percent", 100.0 * steel.steel.distortion, section=Section.REPORT),
        *(
            Figure("{beacon}.steel_map_error_ratio", ratio, beacon=name, section=Section.REPORT)
            for name, ratio in steel.held_out.items()
        ),
    )


def log_steel(recording: rr.RecordingStream, steel: SteelMap) -> None:
    """Draw the voxels with steel, each as large as its polarisability: grey where it is unsure."""
    voxels, (size, sigma) = steel.voxels, steel.polarisability
    drawn = size > MIN_DRAWN * np.max(size)
    # A sphere of iron has a polarisability of three times its volume.
    radius = np.cbrt(size[drawn] / (4.0 * np.pi))
    colours = np.where((size > DRAWN_SIGMAS * sigma)[drawn, None], _STEEL, _UNSURE)
    points = rr.Points3D(voxels.centre_world[drawn], radii=radius, colors=colours)
    recording.log("world/steel", points, static=True)
