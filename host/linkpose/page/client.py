"""What linkpose changes in viser's client program, which runs in the browser: its title, and how often it draws."""

from __future__ import annotations

# viser's client draws frames for 250 ms after each message about the scene, at the rate of the screen; with an update
# each 55 ms, that is always. Where the processor stands in for a graphics card, frames that show nothing new keep it
# busy, and a new value waits until they are done. There, a message that only moves nodes or changes the panel gets one
# frame: its effects are all in it, or request a frame of their own. The quad of the background image, which the page
# does not have, is not drawn: the card would drop its pixels at no cost, the processor computes each. What the script
# uses of the client is there for viser's own tests; if another version lacks it, frames are drawn as viser does.
_SCRIPT = r"""<script>
(() => {
  const isSoftware = state => {
    const context = state.gl.getContext(), names = context.getExtension("WEBGL_debug_renderer_info");
    const name = context.getParameter(names ? names.UNMASKED_RENDERER_WEBGL : context.RENDERER);
    return /swiftshader|llvmpipe|lavapipe|softpipe|software|basic render/i.test(name);
  };
  const only = /^(SetOrientation|SetPosition|SetSceneNodeVisibility|SceneNodeUpdate|GuiUpdate)Message$/;
  const adapt = client => {
    const state = client.scene.__r3f.root.getState(), drawForAWhile = client.requestRender;
    if (!isSoftware(state)) return;
    client.backgroundMaterial.visible = false;
    client.requestRender = () => {
      const waiting = client.messageQueue;
      if (waiting.length && waiting.every(message => only.test(message.type))) state.invalidate();
      else drawForAWhile();
    };
  };
  Object.defineProperty(window, "__viserMutable", {
    configurable: true,
    set(client) {
      Object.defineProperty(window, "__viserMutable", {value: client, configurable: true, writable: true});
      try { adapt(client); } catch (reason) { console.warn("linkpose: frames are drawn as viser does:", reason); }
    },
  });
})();
</script>"""


def titled(page: str) -> str:
    """viser's page with linkpose's title; viser has no parameter for it."""
    return page.replace("<title>Viser</title>", "<title>linkpose</title>", 1)


def adapted(page: str) -> str:
    """viser's page as linkpose serves it."""
    return titled(page).replace("<head>", f"<head>{_SCRIPT}", 1)
