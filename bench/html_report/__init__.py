"""Reports as a single HTML page that needs no network: contents of the page, and scripts that draw them."""
