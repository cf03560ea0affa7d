"""The compiled core: hand-written C for algebra and book-keeping, generated C for every formula, and its loading."""
