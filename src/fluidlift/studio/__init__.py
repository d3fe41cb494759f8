"""A page in the browser on which a person sees what was found of a clip, puts it right and has it made.

Modules of the face:

    app  The server of the page: on this machine alone, for who knows its address
"""

__all__ = ["app"]
