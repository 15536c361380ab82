"""A map of keyframes: loop closures, a pose graph, and relocalisation."""
