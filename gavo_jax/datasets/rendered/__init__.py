"""Sequences that are rendered: rooms with textures and bodies that move, and what they truly are."""
