"""Parts that all command lines share: errors in one line and options."""
