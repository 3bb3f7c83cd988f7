"""The Earth: what node, replay and simulator alike need to know of the map frame on it."""
