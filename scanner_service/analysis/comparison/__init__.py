"""Methods of normal estimation side by side on clouds whose normals are known, after Dey, Li and Sun (2005)."""
