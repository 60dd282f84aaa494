"""A file says whose its normals are when this program wrote it; of all others they are the file's own."""

import numpy as np
import pytest

from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.point_stream import stream_of
from scanner_service.storage.exports.points_pcd import write_pcd
from scanner_service.storage.exports.points_ply import write_ply, write_points_ply
from scanner_service.storage.formats import ReadOptions, open_cloud
from scanner_service.storage.formats.normals_of import BY_ANALYSIS, normals_of
from tests.unit.storage.map_snapshots import plate


def test_points_of_a_live_map_say_so_and_an_analysis_says_so_too(tmp_path):
    snapshot = plate()
    judged = np.zeros(len(snapshot), bool)
    write_points_ply(tmp_path / "map.ply", snapshot, judged)
    write_points_ply(tmp_path / "analysis.ply", snapshot, judged, normals_by=BY_ANALYSIS)
    for name, write in (("export.ply", write_ply), ("export.pcd", write_pcd)):
        with (tmp_path / name).open("wb") as file:
            write(file, stream_of(snapshot, judged), About(session_id="x"))
    told = {file.name: open_cloud(file, ReadOptions()).normals_of for file in tmp_path.iterdir()}
    assert told == {
        "map.ply": "live map",
        "export.ply": "live map",
        "export.pcd": "live map",
        "analysis.ply": "scanner analyse",
    }


@pytest.mark.parametrize(
    ("comments", "whose"),
    [
        ((), "file"),
        (("made by hand", "normals of the live map of somebody"), "file"),
        (("scanner-service 0.1.0", 'about {"software": "scanner-service 0.1.0"}'), "live map"),  # of an older version
        (('about {"software": "another program"}',), "file"),
    ],
)
def test_whose_normals_they_are_is_told_by_the_header_alone(comments, whose):
    assert normals_of(comments) == whose
