"""usd-core comes without stubs: its modules are compiled, and what they hold is known at run time only."""

from typing import Any

def __getattr__(name: str) -> Any: ...
