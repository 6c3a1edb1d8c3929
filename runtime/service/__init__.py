"""The service that owns the headset's devices: programs hand it pictures, it shows them by the displays' clock.

supervisor       this process: sockets, panel, lasers, heartbeat, metrics
solver_process   pictures to patterns
camera_process   the camera and its library
client           what a program uses; hololoop_service.h is the same for C
"""
