"""Forward kinematics, Jacobians and the configuration manifold: pure functions of a robot and a configuration."""

from ._forward import Kinematics as Kinematics
from ._forward import center_of_mass as center_of_mass
from ._forward import com_jacobian as com_jacobian
from ._forward import forward_kinematics as forward_kinematics
from ._forward import frame_jacobian as frame_jacobian
from ._inertia import centroidal_momentum_matrix as centroidal_momentum_matrix
from ._inertia import mass_matrix as mass_matrix
from ._manifold import difference as difference
from ._manifold import integrate as integrate
