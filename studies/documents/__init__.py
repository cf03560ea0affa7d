"""Tables and figures of reports, as the documents show them."""
