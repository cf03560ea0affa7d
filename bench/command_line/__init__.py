"""What all command lines share: errors in one line, the words that were typed, the options of studies."""
