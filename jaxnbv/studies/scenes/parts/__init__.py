"""Procedural objects of ShapeNet-part's categories, labelled by its parts: random proportions, variants and extras."""
