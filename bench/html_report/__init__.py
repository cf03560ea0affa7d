"""Reports as one HTML page that needs no network: contents from the commands, and the engine that draws them."""
