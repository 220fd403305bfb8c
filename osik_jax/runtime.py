"""The runtime that programs run on: settings of the process, made where they are asked for and never by an import."""

from .execution._cpu_settings import configure_cpu as configure_cpu
