"""The composition root: reads settings and wires everything."""
