"""Live view of a robot in the browser: a control loop in a thread, and pages that show it (extra ``viewer``)."""
