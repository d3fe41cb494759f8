"""The asset in the browser."""
