"""Parts that all command lines share: errors in one line, options and their completion."""
