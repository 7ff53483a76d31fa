"""What clra raises and warns of."""


class DeviceError(RuntimeError):
    """No usable OpenCL device: there is none, none of that name, or it fails the self-test."""


class ClraWarning(UserWarning):
    """A result, or the machine, is not as good as it might be."""
