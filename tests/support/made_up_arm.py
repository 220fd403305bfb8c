"""An arm of six joints with the lengths of a UR5, for tests that need a robot of their own."""

SIX_JOINTS = """
<mujoco>
  <compiler angle="radian" autolimits="true"/>
  <default><joint range="-3 3"/><geom size="0.05" mass="2"/></default>
  <worldbody>
    <body pos="0 0 0.09"><joint name="pan" axis="0 0 1"/><geom/>
      <body pos="0 0.14 0"><joint name="lift" axis="0 1 0"/><geom/>
        <body pos="0 -0.12 0.43"><joint name="elbow" axis="0 1 0"/><geom/>
          <body pos="0 0 0.39"><joint name="wrist1" axis="0 1 0"/><geom/>
            <body pos="0 0.09 0"><joint name="wrist2" axis="0 0 1"/><geom/>
              <body name="tool" pos="0 0 0.09"><joint name="wrist3" axis="0 1 0"/><geom/></body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
