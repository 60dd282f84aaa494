"""PLY files made by hand, value by value with `struct`, so that the readers are judged by something else."""

import struct

CODES = {"uchar": "B", "char": "b", "short": "h", "ushort": "H", "int": "i", "uint": "I", "float": "f", "double": "d"}


def ply(encoding, elements, extra=(), end="\n"):
    """A PLY file. `elements` are (name, properties, rows); a property is (name, type) or (name, count type, type)."""
    head = ["ply", f"format {encoding} 1.0", *extra]
    for name, properties, rows in elements:
        head.append(f"element {name} {len(rows)}")
        for label, *types in properties:
            head.append(f"property {'list ' if len(types) == 2 else ''}{' '.join(types)} {label}")
    body = b""
    order = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    for _, properties, rows in elements:
        for row in rows:
            words = []
            for (_, *types), value in zip(properties, row, strict=True):
                if len(types) == 2:
                    words += [(types[0], len(value)), *((types[1], item) for item in value)]
                else:
                    words.append((types[0], value))
            if order is None:
                body += (" ".join(repr(value) for _, value in words) + end).encode()
            else:
                body += b"".join(struct.pack(order + CODES[kind], value) for kind, value in words)
    return (end.join([*head, "end_header"]) + end).encode() + body


XYZ = [("x", "double"), ("y", "double"), ("z", "double")]


def grid_info(rows, columns, *more):
    return [f"obj_info num_rows {rows}", f"obj_info num_cols {columns}", *(f"obj_info {line}" for line in more)]


def grid_file(encoding, vertices, cells, rows, columns, *more):
    """A PLY file with a range grid: `cells` are lists of vertex indices, row by row."""
    elements = [
        ("vertex", XYZ, vertices),
        ("range_grid", [("vertex_indices", "uchar", "int")], [(list(cell),) for cell in cells]),
    ]
    return ply(encoding, elements, grid_info(rows, columns, *more))
