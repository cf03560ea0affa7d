"""Reports as a single HTML page that needs no network: their contents, and the scripts that draw them."""
