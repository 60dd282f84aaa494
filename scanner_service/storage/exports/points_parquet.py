"""Points as Apache Parquet, a row group a block; knows the columns, computes nothing."""

from typing import Any, BinaryIO

import numpy as np

from scanner_service.rescan.judgement import Reason
from scanner_service.storage.exports.about import About
from scanner_service.storage.exports.optional import parquet_modules
from scanner_service.storage.exports.point_stream import PointBlock, PointStream

_GROUP_POINTS = 1 << 18


def write_parquet(file: BinaryIO, stream: PointStream, about: About) -> None:
    """Write points in millimetres of the part frame; null where a normal is not reliable or a value not known.

    Columns are those of the CSV table, and `boot_id`. What the file comes from is in its metadata under `about`.

    Raises
    ------
    ExtraMissing : pyarrow is not installed.
    """
    pyarrow, parquet = parquet_modules()
    schema = _schema(pyarrow, stream.is_judged).with_metadata({"about": about.to_text()})
    with parquet.ParquetWriter(file, schema, compression="zstd") as writer:
        waiting: list[Any] = []
        for block in stream.blocks():
            waiting.append(pyarrow.table(_columns(pyarrow, block), schema=schema))
            if sum(len(table) for table in waiting) >= _GROUP_POINTS:
                writer.write_table(pyarrow.concat_tables(waiting))
                waiting = []
        if waiting:
            writer.write_table(pyarrow.concat_tables(waiting))


def _schema(pyarrow: Any, is_judged: bool) -> Any:
    named = pyarrow.dictionary(pyarrow.int32(), pyarrow.string())
    fields = [("device", named), ("boot_id", pyarrow.int64()), ("pass", pyarrow.int32()), ("line", pyarrow.int64())]
    fields += [("index", pyarrow.int32())]
    fields += [(name, pyarrow.float64()) for name in ("x_mm", "y_mm", "z_mm")]
    fields += [(f"laser_{axis}_mm", pyarrow.float64()) for axis in "xyz"]
    fields += [("line_spacing_mm", pyarrow.float64())]
    fields += [(name, pyarrow.float64()) for name in ("nx", "ny", "nz", "density_per_mm2", "radius_mm")]
    fields += [("neighbours", pyarrow.int32()), ("reliable", pyarrow.bool_()), ("scanline", pyarrow.int32())]
    if is_judged:
        fields += [("rescan", pyarrow.bool_()), ("reason", named)]
    return pyarrow.schema(fields)


def _columns(pyarrow: Any, block: PointBlock) -> dict[str, Any]:
    points, laser, normals = block.points, block.laser_mm, block.normals
    columns: dict[str, Any] = {
        "device": _named(pyarrow, block.of_line("device"), points.lines.device_ids),
        "boot_id": block.of_line("boot_id"),
        "pass": block.of_line("pass_number"),
        "line": block.of_line("line_index"),
        "index": points.index,
        "line_spacing_mm": block.of_line("line_spacing_mm"),
        "density_per_mm2": points.density_per_mm2,
        "radius_mm": points.radius_mm,
        "neighbours": points.neighbours,
        "reliable": points.reliable,
        "scanline": points.line,
    }
    for axis, name in enumerate("xyz"):
        columns[f"{name}_mm"] = points.points_mm[:, axis]
        columns[f"laser_{name}_mm"] = laser[:, axis]
        columns[f"n{name}"] = pyarrow.array(normals[:, axis], from_pandas=True)  # NaN becomes null
    if block.rescan is not None:
        columns["rescan"] = block.rescan
        reason = np.zeros(len(block), np.uint8) if block.reason is None else block.reason
        columns["reason"] = _named(pyarrow, reason, [reason.label for reason in Reason])
    return columns


def _named(pyarrow: Any, codes: Any, names: Any) -> Any:
    return pyarrow.DictionaryArray.from_arrays(
        np.asarray(codes, dtype=np.int32), pyarrow.array(list(names), pyarrow.string())
    )
