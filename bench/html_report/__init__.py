"""Reports as one page that a browser opens without a network: contents by commands, and the engine that draws them."""
