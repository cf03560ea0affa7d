"""The study of narrow places: drawn worlds and named ones, our controller beside peers that see the same."""
