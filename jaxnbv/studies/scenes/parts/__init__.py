"""Procedural objects in the categories of ShapeNet-part, with labelled parts and random proportions."""
