"""The page that holds our figures against the paper's."""
