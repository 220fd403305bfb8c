"""Build hook: compile the C++ core if there is a compiler; without one the package is plain Python."""

import importlib.util
import sysconfig
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class CoreHook(BuildHookInterface):
    """Compiles ``osik_jax/core`` in place, where it has changed, and puts the libraries into the wheel."""

    def initialize(self, version, build_data):
        """Compile before the wheel is written; a failure is a warning."""
        path = Path(self.root) / "osik_jax" / "core" / "_build.py"
        spec = importlib.util.spec_from_file_location("_build", path)
        assert spec is not None and spec.loader is not None
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        try:
            libraries = module.build_if_changed()
        except RuntimeError as problem:
            self.app.display_warning(f"osik_jax is installed without its compiled core, which is slower: {problem}")
            return
        if version != "editable":  # there the libraries are used where they were built
            for library in libraries:
                build_data["force_include"][str(library)] = f"osik_jax/core/{library.name}"
        build_data["pure_python"] = False
        tag = sysconfig.get_platform().replace("-", "_").replace(".", "_")
        build_data["tag"] = f"py3-none-{tag}"
