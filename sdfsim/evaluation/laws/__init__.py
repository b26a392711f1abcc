"""Laws of mechanics, each written once: see `table`."""
