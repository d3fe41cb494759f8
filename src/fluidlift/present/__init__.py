"""How an asset looks: frames of it as pictures, seamless loops, the card and the report."""
