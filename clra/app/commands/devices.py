"""List the OpenCL devices."""

from clra.app.console import Console


def devices(console: Console) -> None:
    """List the OpenCL devices.

    * marks the one that is taken.

    Examples
    --------
      clra devices
      clra devices --device pocl
    """
    from clra.ops.runtime import devices

    found = devices.devices()
    chosen = devices.choose_device(console.device)  # refuses where there is none
    taken = [info.index for info in found if devices.choose_device(info.index) == chosen][:1]
    lines = [
        f"{'*' if info.index in taken else ' '} {info.index:<5}{info.kind:<6}{info.name}: "
        f"{info.compute_units} units, {info.memory / 2**30:.1f} GiB "
        f"(largest buffer {info.largest_buffer / 2**30:.1f} GiB), {info.platform}, "
        # some drivers add a list of everything they were built with
        f"{info.version.partition('  ')[0]}"
        for info in found
    ]
    console.result({"devices": found, "taken": taken[0] if taken else None}, "\n".join(lines))
