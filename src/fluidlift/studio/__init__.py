"""A page in the browser on which a person sees what was found of a clip, puts it right and has it made."""
