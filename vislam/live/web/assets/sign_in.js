// The token comes in the address, behind the #, where no server and no log sees it; it is shown once for a cookie.
const form = document.getElementById("form");
const field = document.getElementById("token");
const said = document.getElementById("said");

async function signIn(token) {
  said.textContent = "";
  try {
    const answer = await fetch("/sign-in", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ token: token.trim() }),
    });
    if (answer.ok) return location.replace("/");
    said.textContent = "This is not the token of this run.";
  } catch (error) {
    said.textContent = "Nothing answers here any more.";
  }
}

form.addEventListener("submit", (event) => {
  event.preventDefault();
  signIn(field.value);
});
const given = location.hash.slice(1);
if (given) {
  history.replaceState(null, "", "/");
  signIn(given);
}
