"""From a robot motion and an object to a reference: the object's trajectory, contact labels and contact points.

```python
annotated = annotate_motion(motion, object=box, effectors=hands, overrides=load_overrides("annotation.yaml"))
```
"""

from hdmi.assets.surface import Surface, object_surfaces
from hdmi.workshop.annotate.contacts import (
    ContactCriteria,
    contact_points,
    find_contacts,
    intervals,
    label_contacts,
    without_chatter,
)
from hdmi.workshop.annotate.labelling import Agreement, agreement, annotate_motion, complete_object
from hdmi.workshop.annotate.overrides import FILE, Interval, Overrides, load_overrides
from hdmi.workshop.annotate.trajectory import complete_hinge, complete_trajectory

__all__ = [
    "FILE",
    "Agreement",
    "ContactCriteria",
    "Interval",
    "Overrides",
    "Surface",
    "agreement",
    "annotate_motion",
    "complete_hinge",
    "complete_object",
    "complete_trajectory",
    "contact_points",
    "find_contacts",
    "intervals",
    "label_contacts",
    "load_overrides",
    "object_surfaces",
    "without_chatter",
]
