"""Search for a controller configuration, and a comparison on seeds that the search does not use."""
