"""Reports as one page that a browser opens without a network: what commands say, and the engine that draws it."""
