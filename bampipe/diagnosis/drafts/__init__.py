"""A formula for what no effect of the library explains: searched, held against chance, fitted."""
