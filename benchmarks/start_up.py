"""How long a fresh process needs until its kernels are ready; run as a module it is that process, and prints JSON."""

import json
import time


def measure() -> dict[str, float]:
    """Import the live map and make its kernels ready, by the compiler or from this process's cache."""
    begun = time.perf_counter()
    from scanner_service.analysis.compiling import compile_kernels

    imported = time.perf_counter()
    compile_kernels()
    return {"import_s": imported - begun, "ready_s": time.perf_counter() - begun}


if __name__ == "__main__":
    print(json.dumps(measure()))
